"""Tables and figures of Lei & Li 2017, and the two families of controllers on both plants."""
