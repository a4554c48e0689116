"""Sweeps beyond one machine, by Dask (extra `cluster`): what a worker does, what the driver does, how clusters start.

A worker needs nothing of the driver's file system: checkpoints and trajectory files travel to it once, and the file of
a cell travels back with its row and is written by the driver alone. So there is one writer, on one file system, which
keeps "whole or not at all" simple, and a worker may lie on any machine that has this program.
"""
