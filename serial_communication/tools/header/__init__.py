"""`header`: a C++ header for the sketch, from the rows of a configuration. See cli.py."""
