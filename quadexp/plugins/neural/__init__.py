"""A neural network as a model of the air."""

BRINGS = {
    "commands": {"fit-nn": "quadexp.plugins.neural.commands:fit_nn"},
    "api": {"fit_nn": "quadexp.plugins.neural.api:fit_nn"},
    "spellings": {"nn": "neural"},
    "models": {"neural": "quadexp.plugins.neural.neural"},
}
