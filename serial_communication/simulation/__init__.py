"""Simulated boards, which move, measure and refuse as real ones do, and the line between them and
the bridge.

A `Board` is a state machine without I/O: it gets bytes and the time, and sends frames. A
`SimulatedLine` connects it with a port; it adds the faults, the line's speed and the journal. A
`Runner` drives both on a real port. ``scripts/simulator`` is the program.
"""
