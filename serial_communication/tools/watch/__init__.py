"""The state of a running bridge, seen from outside: its topics, its links, and their ages.

The monitor and the panel use this. `topics` lists the topics and turns messages
into numbers and text. `state` keeps what was received and how old it is. Neither imports ROS.
`watcher` fills the state from a master.
"""
