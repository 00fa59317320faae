"""The live table of any bridge that runs: see cli.py."""
