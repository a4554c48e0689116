"""`python -m quadexp` is the command `quadexp`."""

from quadexp.cli import main

main()
