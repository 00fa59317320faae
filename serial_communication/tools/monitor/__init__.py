"""The live table of any running bridge, see cli.py."""
