"""Run the command ``liethermo`` by ``python -m liethermo``."""

from .cli import main

main()
