"""The fault campaign: see cli.py."""
