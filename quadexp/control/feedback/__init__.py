"""Compensated feedback of Lei & Li 2017, equations (27)-(40): position, attitude, observer, allocation.

Everything in this folder is written in the paper's frames, NED for the world and FRD for the body, and converted once
at the edge (frames.py).
"""
