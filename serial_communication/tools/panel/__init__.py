"""The web page of a bridge, and the node that serves it: see cli.py."""
