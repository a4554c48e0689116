"""Any swept key as an axis: what was swept, the points of a figure, and how they are drawn.

frame.py: the value of any key in every flight. where.py: which flights. points.py: means, intervals and lost flights at
every place of a figure. view.py: what to draw. lines.py, heat.py, parallel.py: how.
"""
