"""A running bridge, seen from outside: what the monitor and the panel share."""
