"""Sweeps on several machines with Dask (extra `cluster`): worker, driver, and how clusters are started.

A worker needs no access to the driver's file system: checkpoints and trajectory files are sent to it once, and the file
of a cell is sent back with its row and is written by the driver alone. With a single writer on one file system it is
simple to write a file completely or not at all, and a worker may run on any machine that has this program.
"""
