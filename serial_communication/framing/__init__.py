"""Bytes <-> frames <-> typed messages. Pure: no I/O, no clock, no thread, no rospy.

Every decoder is a `stream.Decoder`.

Every message class has

    TYPE             its type on the wire
    NUMBER           of a setting: the byte with which its data begin, else b''
    LABEL            its name, for people
    LAYOUT           which values its data has, and where
    unpack(data)     the message; struct.error if the data has the wrong length
    pack()           the data; ValueError for a value that its place cannot hold
    implausible()    why its values are impossible, or ''
    str(message)     one line for people

`layout.message_class` makes the simple classes. The others derive from `layout.LayoutMessage` and
override what differs.
"""
