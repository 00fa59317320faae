"""rosrun serial_communication wire: explain, show and play back a serial line.

Each program is a module, which `cli` selects.
"""
