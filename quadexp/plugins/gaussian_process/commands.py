"""The command `quadexp fit-gp`. Only light modules are imported at the top."""

from quadexp.cli.learn import fit_spelling

fit_gp = fit_spelling("gp")
