"""The journal: what a simulated board sent and received, for programs that check a bridge.

Every line is a JSON object. It has ``t``, seconds of CLOCK_MONOTONIC (``time.monotonic()`` of any
process on this machine), and ``ev``, the event. Bytes are hexadecimal. A key in brackets below is
left out where it has the usual value: no faults, one copy, sent, genuine, not behind damage.

All boards:

``start``     ``board`` bus | arduino | mcu, ``port``, ``pid``, ``seed``, ``faults`` {kind: rate}
``port``      ``open`` true or false: the board's end of the line was opened or closed
``tx``        the board sent a frame: ``n`` its running number; ``ok`` whether the bridge must
              receive it, since every byte was written unchanged and no bytes before it can hide
              it; [``faults`` the kinds that happened to it]; [``wire`` the bytes that were
              written instead]; [``copies`` 2: it is written twice, in one write or, by the kind
              repeat, again at the line ``copy``]; [``sent`` false: it was not written]; [``why``
              silence, drop, busy or closed]; [``behind_damage`` true: its bytes are right, but
              those before it are damaged, so it may be found or not]; and the keys of the
              board, below
``copy``      ``n``: that frame was written for the second time; [``sent`` false, ``why``]
``chatter``   ``wire``: noise that a board sends at a reset, or an empty packet;
              [``sent`` false, ``why``]
``fault``     ``kind`` silence | stall | reset, ``seconds``: it begins, and its duration
``rx-fault``  ``faults``, ``came`` the bytes read from the port, ``became`` those that the board got
``rx-lost``   ``data``, ``why``: received bytes that the board did not get
``boot``      the board is up, after its start and after every reset
``late``      ``by`` seconds: the computer woke the simulator this late; what it noted shortly
              before and after, heartbeat gaps included, may be wrong
``end``       ``frames`` sent, ``faults`` {kind: how often}

bus:

``request``   ``k`` its running number, ``raw``, ``valid``; if valid, ``text`` and
              [``genuine`` false: a fault made this request, and its checksum matches by chance];
              if not, ``cause``, ``error``, and at most 64 bytes of ``raw``
``executed``  ``n`` running number, ``k`` of the request, ``raw``, ``cmd1``, ``cmd2``, ``data``,
              ``text``, [``genuine`` false]; written when the execution begins
``done``      ``k``: that motion has ended; ``lift`` mm, ``pan`` and ``tilt`` degrees
``tx``        ``k`` of the request it answers (0: a damaged one), ``raw``, ``text``

arduino:

``tx``        ``type``, ``data``
``rx``        a packet was received: ``type``, ``data`` (a heartbeat is type 11); if it is invalid,
              ``raw`` (at most 64 bytes), ``cause``, ``error`` instead
``motor``     ``on``, ``speed`` (-1000 … 1000), ``why``
``calibrate`` ``on`` true as it begins, false as it ends (then ``kept``: bytes read at once)

mcu:

``tx``        ``type``, ``seq``, ``raw``

A damaged frame may have a matching checksum by chance (with an XOR one in 256, but never after a
single flipped bit), and the model car's packets have no checksum. To know what the bridge received
of a frame that is not ``ok``, decode its ``wire``. Written bytes may be lost if the port's other
end is closed or opened in that moment, so a checker ignores some tenths of a second around that.
"""
import json
import os
from typing import List, Optional

_EVERY = 0.5        # s; longest time that a line waits
_BATCH = 500        # most lines that wait


class Journal:
    """Appends whole lines to a file, in batches; a full disk ends the journal, not the board.

    Raises:
        OSError: the file cannot be opened.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.trouble = ''
        self._lines: List[str] = []
        self._due: Optional[float] = None
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)

    def write(self, now: float, event: str, fields: dict) -> None:
        """Add a line; it is written within 0.5 s if `flush_due` is called when it asks for it."""
        if self._fd < 0:
            return
        entry = {'t': round(now, 6), 'ev': event}
        entry.update(fields)
        self._lines.append(json.dumps(entry, separators=(',', ':')) + '\n')
        if self._due is None:
            self._due = now + _EVERY
        if len(self._lines) >= _BATCH:
            self.flush()

    def flush_due(self, now: float) -> Optional[float]:
        """Write the lines if they have waited long enough; return when to be called next, or
        None."""
        if self._due is not None and now >= self._due:
            self.flush()
        return self._due

    def flush(self) -> None:
        """Write all lines at once, so that the file ends with a whole line."""
        lines, self._lines, self._due = self._lines, [], None
        data = ''.join(lines).encode()
        try:
            while data and self._fd >= 0:
                data = data[os.write(self._fd, data):]
        except OSError as error:
            self.trouble = f'journal {self.path}: {error.strerror}; nothing more is written to it'
            self._close()

    def close(self) -> None:
        """Write the waiting lines and close the file."""
        self.flush()
        self._close()

    def _close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1
