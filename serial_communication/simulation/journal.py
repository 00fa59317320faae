"""What a simulated board did and saw, a JSON object a line, for programs that check a bridge.

Every line has ``t``, seconds of CLOCK_MONOTONIC (``time.monotonic()`` of any process on this
machine), and ``ev``, what happened. Bytes are hexadecimal. A key that a line below has in
brackets stands there only if it says something: no faults, one copy, sent, genuine, intact.

All boards:

``start``     ``board`` bus | arduino | mcu, ``port``, ``pid``, ``seed``, ``faults`` {kind: rate}
``port``      ``open`` true or false: the board's end of the line
``tx``        a frame was handed to the port, or should have been: ``n`` its running number,
              ``ok`` whether the other end must find it: every byte went out, as it should, and
              nothing before it can swallow it; [``faults`` the kinds that met it], [``wire`` the
              bytes that went out instead of the right ones], [``copies`` 2: it goes out twice, in
              one write or, of the kind repeat, once more where ``copy`` stands], [``sent``
              false: it never left], [``why`` silence, drop, busy or closed],
              [``behind_damage`` true: its own bytes are right, but what went before it did not end
              as it should: it may be found or not]; and the board's own keys, below
``copy``      ``n``: that frame went out for the second time; [``sent`` false, ``why``]
``chatter``   ``wire``: what a board babbles at a reset, or an empty packet;
              [``sent`` false, ``why``]
``fault``     ``kind`` silence | stall | reset, ``seconds``: it begins, and how long it lasts
``rx-fault``  ``faults``, ``came`` what the port gave, ``became`` what the board was given of it
``rx-lost``   ``data``, ``why``: bytes that came while the board could not take them, or that the
              line lost on demand
``boot``      the board is up, at its start and after every reset
``late``      ``by`` seconds: the simulator itself was woken this late by its machine; what it saw
              just before and after, heartbeat gaps too, may be its own fault
``end``       ``frames`` handed over, ``faults`` {kind: how often}

bus:

``request``   ``k`` its running number, ``raw``, ``valid``; if valid ``text``, [``genuine`` false:
              damage on the way made this of something else and the checksum cannot tell];
              if not ``cause``, ``error``, and of ``raw`` 64 bytes at most
``executed``  ``n`` running number, ``k`` of the request, ``raw``, ``cmd1``, ``cmd2``, ``data``,
              ``text``, [``genuine`` false]; written when the execution begins
``done``      ``k``: a motion that was begun has ended, ``lift`` mm, ``pan`` and ``tilt`` degrees
``tx``        ``k`` of the request it answers (0: of a damaged one), ``raw``, ``text``

arduino:

``tx``        ``type``, ``data``
``rx``        a packet came: ``type``, ``data`` (a heartbeat is type 11); if it is no good packet
              ``raw`` (64 bytes at most), ``cause``, ``error`` instead
``motor``     ``on``, ``speed`` (-1000 … 1000), ``why``
``calibrate`` ``on`` true as it begins, false as it ends (then ``kept``: bytes read at once)

mcu:

``tx``        ``type``, ``seq``, ``raw``

Damage may pass a checksum by chance (an XOR: one in 256, but never a single flipped bit), and the
model car's packets have none: to know what the other end must have made of a frame that is not
``ok``, decode its ``wire``. Bytes handed to a port may still be lost if its other end closes or
reopens in that moment: a checker leaves some tenths of a second around that out of account.
"""
import json
import os
from typing import List, Optional

_EVERY = 0.5        # s that a line waits at most
_BATCH = 500        # lines that wait at most


class Journal:
    """Appends to a file in batches of whole lines; a full disk ends the journal, not the board.

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
        """One line; it reaches the file within half a second if `flush_due` is called."""
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
        """Write what has waited long enough; return when to be called next, or None."""
        if self._due is not None and now >= self._due:
            self.flush()
        return self._due

    def flush(self) -> None:
        """Write all lines in one piece, so that the file ends with a whole one."""
        lines, self._lines, self._due = self._lines, [], None
        data = ''.join(lines).encode()
        try:
            while data and self._fd >= 0:
                data = data[os.write(self._fd, data):]
        except OSError as error:
            self.trouble = (f'journal {self.path}: {error.strerror}; '
                            'no more of it is written')
            self._close()

    def close(self) -> None:
        """Write what waits and close the file."""
        self.flush()
        self._close()

    def _close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1
