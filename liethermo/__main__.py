"""``python -m liethermo`` is the command ``liethermo``."""

from .cli import main

main()
