"""Numbers, tables and figures from flights and results."""

FORMATS = ("svg", "png")  # in which every figure of a folder is written
