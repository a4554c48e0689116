"""What is learned from flights, and what of it is flown: one file a model, with its equation, fit and residual.

Naming a model costs nothing: CasADi is imported by the first expression, torch by the fit of a Gaussian process or a
network; loading a checkpoint and predicting need numpy only.
"""
