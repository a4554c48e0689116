"""Compensated feedback of Lei & Li 2017, equations (27)-(40): position, attitude, observer, allocation.

All equations here are in the paper's frames, NED (world) and FRD (body); frames.py converts from and to ENU and FLU.
"""
