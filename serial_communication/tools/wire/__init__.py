"""rosrun serial_communication wire: what is on a serial line, explained, shown, kept, played back.

A module a program; `cli` finds the one that is asked for. `lines` decodes one direction of a
line, `recording` reads and writes what was kept of it, `live` reads ports, `show` prints.
"""
