"""From flights to models: residual dataset, linear drag, Gaussian processes, checkpoints.

torch is imported for fitting a Gaussian process only; loading a checkpoint and predicting need numpy only.
"""
