"""The command `quadexp fit-nn`. Only light modules are imported at the top."""

from quadexp.cli.learn import fit_spelling

fit_nn = fit_spelling("nn")
