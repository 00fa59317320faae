"""The other end of each protocol: boards that move, measure and refuse as real ones do.

A board is a state machine without I/O: it is given bytes and the time, and emits frames. A
`Line` stands between it and its port: there are the faults on demand, the line's speed and the
journal. A `Runner` drives the two on one port. ``scripts/simulator`` makes it a program.
"""
