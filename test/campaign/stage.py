"""What a campaign runs beside the roscore and the bridge: cables, simulated boards, users.

Each is a process of its own, in a folder of the campaign's own.
"""
import os
import signal
import sys
import time
from typing import Any, Dict, List, Optional

from processes import Child, Stage, StageError
from .records import Lines

_SCRIPTS = os.path.join(os.path.dirname(os.path.realpath(__file__)), *[os.pardir] * 2, 'scripts')
CABLE_PRIORITY = 15      # real-time: between the simulated boards' and the heartbeat's
_START = 30.0            # s that a cable may take to start
FILLING = 6000           # bytes, more than a pseudo terminal's 4095


class Cable:
    """A socat pair: `near` is the bridge's end, `far` the board's."""

    def __init__(self, stage: 'CampaignStage', name: str) -> None:
        self.name = name
        self.near = os.path.join(stage.folder, name)
        self.far = os.path.join(stage.folder, name + '_board')
        self._stage = stage
        self._child: Optional[Child] = None
        self._spares: List[int] = []

    def plug(self) -> float:
        """Make it; returns when both ends are there: the time."""
        self._child = self._stage.child('cable_' + self.name, [
            os.path.join(_SCRIPTS, 'socat_pair'), self.near, self.far], priority=CABLE_PRIORITY)
        deadline = time.monotonic() + _START
        while not (os.path.exists(self.near) and os.path.exists(self.far)):
            if time.monotonic() > deadline or not self._child.alive:
                raise StageError(f'socat does not start: {self._child.tail()}')
            time.sleep(0.002)
        now = time.monotonic()
        self._stage.events.write(t=now, ev='plugged', link=self.name,
                                 device=os.path.realpath(self.near))
        return now

    def unplug(self, another_name: bool = False) -> float:
        """Cut it; with `another_name` it comes back as another device. The time."""
        if another_name:
            # Whoever takes the numbers that become free leaves others for the cable.
            self._spares.append(os.open('/dev/ptmx', os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC))
        now = time.monotonic()
        self._stage.events.write(t=now, ev='unplugged', link=self.name)
        self._stage.end(self._child, signal.SIGKILL)
        for end in (self.near, self.far):
            if os.path.islink(end):
                os.unlink(end)
        if len(self._spares) > 3:
            os.close(self._spares.pop(0))
        return now

    def freeze(self, bridge: Child) -> None:
        """Nothing crosses it any more: what either end writes stays in the kernel."""
        self._stage.events.write(t=time.monotonic(), ev='frozen', link=self.name)
        # On a busy machine it may read on for a while. What comes now has to stay where it is.
        self._child.hold()
        # What a pseudo terminal's other end could read at once is beyond the bridge's flush, as
        # no byte in a UART's buffer is. So that much is 0x00, no packet for anybody. A terminal
        # lets one at a time write: the bridge, refused, would drop them before they are there.
        bridge.hold()
        self._write_zeros(FILLING)
        bridge.send(signal.SIGCONT)
        self._stage.events.write(t=time.monotonic(), ev='filled', link=self.name)

    def fill(self) -> None:
        """Leave the bridge no room to write, as if it had written it full itself."""
        self._write_zeros(1 << 20)

    def _write_zeros(self, count: int) -> None:
        try:
            fd = os.open(self.near, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError:
            return
        try:
            while count > 0:
                count -= os.write(fd, bytes(min(count, 4096)))
        except OSError:
            pass        # it is full
        finally:
            os.close(fd)

    def thaw(self) -> None:
        """All crosses it again, what waits first."""
        self._stage.events.write(t=time.monotonic(), ev='thawed', link=self.name)
        self._child.send(signal.SIGCONT)

    def noise(self, data: bytes) -> bool:
        """Put bytes on the line towards the bridge, which the board does not know of."""
        try:
            fd = os.open(self.far, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError:
            return False
        now = time.monotonic()
        try:
            os.write(fd, data)
            self._stage.events.write(t=now, ev='noise', link=self.name,
                                     data=data.hex())
            return True
        except OSError:
            return False
        finally:
            os.close(fd)

    def close(self) -> None:
        while self._spares:
            os.close(self._spares.pop())


class Pipe:
    """A pipe for what the bridge says, whose reader goes and comes back.

    Args:
        log: where what is read is kept.
    """

    def __init__(self, stage: 'CampaignStage', path: str, log: str) -> None:
        self._stage = stage
        self._path = path
        self._log = log
        os.mkfifo(path)
        self._reader = -1
        self._open()
        self.writer = os.open(path, os.O_WRONLY | os.O_CLOEXEC)

    def _open(self) -> None:
        self._reader = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)

    def take(self) -> None:
        """Read what there is."""
        try:
            data = os.read(self._reader, 1 << 16) if self._reader >= 0 else b''
        except BlockingIOError:
            return
        with open(self._log, 'ab') as log:
            log.write(data)

    def leave(self) -> None:
        """From now on whoever writes to it gets an error."""
        self.take()
        self._stage.events.write(t=time.monotonic(), ev='unread')
        os.close(self._reader)
        self._reader = -1

    def come_back(self) -> None:
        """Read again."""
        self._open()
        self._stage.events.write(t=time.monotonic(), ev='read again')

    def close(self) -> None:
        """At the end."""
        for fd in self._reader, self.writer:
            if fd >= 0:
                os.close(fd)
        self._reader = self.writer = -1


class CampaignStage(Stage):
    """The campaign's folder is where its records are; `events` is what it did itself."""

    def __init__(self, keep: str = '', bridge: str = '') -> None:
        super().__init__('serial_communication_soak_', keep, bridge)
        self.events = Lines(self.path('events.jsonl'))
        self.cables: Dict[str, Cable] = {}

    def __exit__(self, *_: Any) -> None:
        super().__exit__()
        for cable in self.cables.values():
            cable.close()
        self.events.close()

    def cable(self, name: str) -> Cable:
        """A new one, plugged in."""
        cable = self.cables[name] = Cable(self, name)
        cable.plug()
        return cable

    def board(self, kind: str, far: str, seed: int, *options: str, journal: str = '',
              name: str = '') -> Child:
        """A simulated board."""
        return self.child(name or kind + '_board', [
            sys.executable, '-c', 'import sys; from serial_communication.simulation.cli import '
            'main; sys.exit(main())', kind, '--port', far, '--seed', str(seed),
            '--journal', journal or self.path(kind + '.journal'), *options])

    def user(self, role: str, file: str, seed: int, *remappings: str, name: str = '',
             **options: Any) -> Child:
        """A process of children.py."""
        return self.child(name or role, [
            sys.executable, '-m', __package__ + '.children', role, self.path(file), str(seed),
            *remappings], **options)


def say(text: str) -> None:
    """What is done, for who waits."""
    print(text, file=sys.stderr)
