"""Frames, units and orders of a log's columns, from what the data obey: for `import --describe` and for `check`.

A hypothesis (hypothesis.py) is a transformation of a log's streams: another unit, frame, order of a quaternion, sign,
clock or mounting of a sensor. Kinematics (windows.py) says how well the streams agree under it, a score with a margin
(search.py) decides, and the hypothesis that explains the data is the correction of the mapping. `quadexp check` states
the fault and its correction; `import --describe` (conventions.py) builds the mapping from them.
"""
