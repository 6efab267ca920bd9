"""`python -m ctmhe.cli`."""

from ctmhe.cli import main

main()
