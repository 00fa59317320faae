"""rosrun serial_communication wire: explain, show, record and play back a serial line.

Each program is a module, which `cli` selects. `lines` decodes one direction of a line, `recording`
reads and writes recordings, `live` reads ports, `display` prints frames, `show` formats them.
"""
