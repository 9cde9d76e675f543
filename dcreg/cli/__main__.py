"""``python -m dcreg.cli`` is the command ``dcreg``."""

from dcreg.cli import main

main()
