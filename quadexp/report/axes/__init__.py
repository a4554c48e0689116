"""Any swept key as an axis: what was swept, the points of a figure, and how they are drawn.

frame.py: the value of any key in every flight. points.py: means, intervals and lost flights at
every place of a figure. view.py: what to draw. draw.py: how.
"""
