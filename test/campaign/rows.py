"""The fixed list of requirements, by group, with how often each has to be checked at least.

In each run of the exact part; in the groups of the storm, in each minute of it. A requirement that
was checked less often is not fulfilled, whatever the reason is.
"""

ROWS = """
node
   100 at most one log line in 10 s for each cause and link
   500 no traceback and no stuck link in the log
   100 the terminal shows the log and nothing else
    28 what happened is in the log
     7 the counters in /diagnostics are exact
    11 level and words in /diagnostics are true
     3 a second bridge with the same name ends; the first continues
     2 topics, services, parameters return within 10 s of a new master
     2 without a master the ports stay open and commands arrive
    63 it ends within 2 s, whatever hangs; last packet SPEED 0
campaign
    44 every scenario runs to its end
bus
    64 outcome done: executed exactly once
    16 outcome refused or not sent: not executed
    34 outcome not known: executed at most once
    77 a motion is sent again only if it was not executed
   108 the outcome of a call matches what the board replied
   108 a call returns within timeout + 0.8 s + 0.2 s for ROS
   129 no late or doubled reply is used for another request
   327 a fence, an ECHO with a fresh nonce, precedes every call
    12 a board that never echoes: 20 ms of silence before each call
     3 until SYNC is answered nothing else is sent
    10 at most one request is outstanding
     3 a request that reads is sent again, and published once
     6 requests and replies with up to 1024 bytes arrive unchanged
     6 a stop is sent within 50 ms, whatever is outstanding
     3 a false start is given up after its wire time, whatever comes
     4 a call that timed out unheard does not arrive later
    12 a call from the time of a stall, or 0.5 s after it, is not sent
     9 a suspended caller delays no other call; its outcome is true
     3 after a reconnect the first request is SYNC
     1 after a reset of the board SYNC brings it in step again
     4 a function is sent only to the board that announced it
    40 every polled value is from a reply to that function
ports
     2 changed settings of a tty are restored within 0.3 s
     9 data within 1.5 s of the port's return
     1 a port that is absent at the start is opened when it appears
heartbeat
 12000 no gap of 30 ms between heartbeats, whatever else happens
     2 heartbeats: 100 a second
data
  2000 every valid frame is published once, in order, unchanged
   100 serial_msg has every received and sent frame once, in order
    35 bytes that waited during a stall are dropped, counted as stale
     1 a stall of 0.2 s loses nothing
     6 data is published again within 1 s of a stall
     3 every error is counted by cause and costs no valid frame
     1 every lost and every doubled frame is counted
stamps
  1500 between the frame's write and the message's arrival
     6 a frame after a false start keeps the stamp of its read
commands
   125 every command reaches the board of an open port
     9 values arrive unchanged; SPEED limited, LED text checked
    10 of a burst of commands each arrives at most once, in order, and the last
     2 a calibration ends with the first IMU data after a silence of 2 s
motor
    33 no command from before a reconnect, stall or restart
    10 SPEED 0 within speed_timeout + 50 ms of the last command
     4 no SPEED 0 before speed_timeout, unless it was commanded
   250 a SPEED 0 that ends a motion is repeated every 50 ms for 1 s
     9 SPEED 0 is the first packet whenever the port opens
     2 SPEED 0 is the first packet after dropped output
     2 SPEED 0 is the first packet after a stall of over 0.5 s
     6 SPEED 0 precedes a calibration; nothing is sent during it
old commands
    18 a stamp over 0.5 s off is refused, except for SPEED 0
    21 an old latched command is refused, a new one is sent
    11 only the newest connection of each publisher is used
     2 no command that waited unseen in a pty for over 1.5 s arrives
presence
     9 a silent sensor board: reports each second, no old values
announcements
     6 the rows of the last whole text are in use, no others
     9 no command and no value after a reconnect, until announced again
network
     8 no SPEED older than 1.5 s reaches a board behind socket://
     8 heartbeats within 3 s of the network's return
     6 no data from the time of a stall is published over a network
storm
   146 writes that were damaged, in both directions
storm: motor
    67 every SPEED was commanded, and is sent once
    67 no SPEED over 0.7 s after its command
   621 storm: SPEED 0 within speed_timeout + 50 ms
     2 storm: SPEED 0 is the first packet whenever the port opens
storm: bus
    59 storm: outcome done: executed exactly once
   262 storm: outcome refused or not sent: not executed
    14 storm: outcome not known: executed at most once
    59 a raw call returns the data of its own reply
   335 every call returns (worst: over timeout + 0.8 s)
   141 every request belongs to a call that waits, or to a poll
    81 a request comes again only after INVALID
storm: data
  4562 every published value was in a valid frame, in order, once
  6895 values are lost only beside a stall or a reconnect
storm: node
     1 no growth: memory
     1 no growth: threads
     1 no growth: files
"""
