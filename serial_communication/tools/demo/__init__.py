"""The live table of scripts/demo, see cli.py."""
