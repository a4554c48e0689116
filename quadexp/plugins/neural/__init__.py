"""A neural network as a model of the air."""

BRINGS = {
    "commands": {"fit-nn": "quadexp.plugins.neural.commands:fit_nn"},
    "models": {"neural": "quadexp.plugins.neural.neural"},
}
