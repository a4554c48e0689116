"""Gaussian processes as a model of the air."""

BRINGS = {
    "commands": {"fit-gp": "quadexp.plugins.gaussian_process.commands:fit_gp"},
    "models": {"gaussian_process": "quadexp.plugins.gaussian_process.gaussian_process"},
    "api": {"fit_gp": "quadexp.plugins.gaussian_process.api:fit_gp"},
    "spellings": {"gp": "gaussian_process"},
}
