"""``python -m dcreg`` is the command ``dcreg``."""

from dcreg.cli import main

main()
