"""`python -m qsgm.cli`."""

from qsgm.cli import main

main()
