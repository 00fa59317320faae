"""A line for the test of names."""
from link_fixtures import line  # noqa: F401
