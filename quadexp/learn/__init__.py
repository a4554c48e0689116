"""From flights to models: residual dataset, linear drag, Gaussian processes, checkpoints.

Nothing here imports torch until a Gaussian process is fitted: loading and predicting from a checkpoint take numpy only.
"""
