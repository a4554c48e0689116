"""`python -m quadexp` is the command `quadexp`."""

from quadexp.cli.app import main

main()
