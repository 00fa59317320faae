"""All that is sent to the model car: commands, heartbeats, and SPEED 0 before them where needed.

Only this module, `motor` and `calibration` decide what may reach the motor, and when.
"""
import threading
import traceback
from typing import Dict, Optional, Tuple

from ...framing.layout import LayoutMessage
from ...framing.settings import SettingMessage
from ...link.link import Link, Refused
from ...link.outcome import STOPPED
from ...transport.output_watch import LONGEST_WAIT, OutputWatch
from ...transport.port import PortBusy, PortError
from . import wire
from .calibration import Calibration
from .line_time import LineTime
from .motor import EARLY, REPEAT_FOR, REPEAT_PERIOD, STALL, Motor, Stop

_LONGEST_BURST = 0.05    # s of wire time that may wait; then more commands are refused
_LONGEST_WAIT_NETWORK = 1.0     # s, instead of LONGEST_WAIT: a network may pause
_LONGEST_WAIT_AT_END = 0.05     # s, likewise: the last SPEED 0 has to leave
_BEATS = 0.03            # s since the latest heartbeat in which its thread counts as running
_LAST_STOP_TIME = 0.1    # s for the last SPEED 0 to leave the port before it is closed
_CALIBRATES = 'the board calibrates its IMU, which takes minutes'
_STALLED = 'it may have waited while the bridge stalled; send it again'
_SPEED_0 = wire.SpeedCommand(0)
_HEARTBEAT = wire.Heartbeat()
_HEARTBEAT_PACKET = wire.encode(_HEARTBEAT)
_STILL = wire.SteeringCommand, wire.LedCommand, SettingMessage    # what ~stop does not refuse
_OVERHEAD = 4            # bytes of a packet besides its data, at most


class CarOutput:
    """Takes commands from any thread; each is written to an open port at once, or refused.

    Args:
        link: whose port it writes to.
        speed_timeout: s after the last speed command until SPEED 0 is sent; 0: never.
        calibration_timeout: s after which a calibration counts as over.
    """

    def __init__(self, link: Link, speed_timeout: float, calibration_timeout: float) -> None:
        self._now = link.now
        self.lock = threading.Lock()         # held while anything is sent; guards all below
        self.motor = Motor(speed_timeout, self._now())
        self.calibration: Optional[Calibration] = None
        self.is_held = False                 # the other side of a pty may hold what is written
        self._link, self._port, self._log = link, link.port, link.log
        self._speed_timeout = speed_timeout
        self._calibration_timeout = calibration_timeout
        self._cut_off = False                # the latest packet may have been sent in part
        self._has_ended = False              # the last SPEED 0 is sent: nothing may follow it
        self._watch = OutputWatch(link.port)
        self._stands = False                 # what waited was dropped, and nothing has left since
        self._line = LineTime(10.0 / link.port.baud)
        self._beat_at = float('-inf')        # when its thread sent the latest heartbeat
        # The zero of each motion besides the speed, by type: a row of type geometry_msgs/Twist.
        self._zeros: Dict[int, LayoutMessage] = {}
        self._zeros_until: Dict[int, float] = {}     # those that are repeated by now
        self._zeros_at = 0.0                 # when they are repeated next
        self.extra_beats = 0                 # heartbeats among commands, sent by other threads

    def command(self, message: LayoutMessage) -> None:
        """Send any message, and SPEED 0 before a calibration if the car moves; Refused if it cannot
        be sent now."""
        with self.lock:
            now = self._now()
            self._check_for_stall(now)
            why, cause = self._why_not(message, now)
            if why:
                if cause == 'busy':
                    self._stop_later(message)
                raise Refused(f'{message} refused: {why}', cause)
            calibrates = isinstance(message, wire.ImuCalibration)
            try:
                if calibrates and self.motor.moving:
                    self._send(_SPEED_0, now)
                self._send(message, now)
            except (PortBusy, PortError) as error:
                busy = isinstance(error, PortBusy)
                if busy:
                    self._stop_later(message)
                raise Refused(f'{message} refused: {error}', 'busy' if busy else 'port') from None
            self._zeros_until.pop(message.TYPE, None)
            if calibrates:
                self.calibration = Calibration(self._calibration_timeout, now)

    def add_motion(self, zero: LayoutMessage) -> None:
        """~stop sends this message, too, which stops what commands of its type move."""
        with self.lock:
            self._zeros[zero.TYPE] = zero
            if self._link.is_stopped:
                self._begin_zeros()

    def remove_motion(self, zero: LayoutMessage) -> None:
        """Undo `add_motion`."""
        with self.lock:
            self._zeros.pop(zero.TYPE, None)
            self._zeros_until.pop(zero.TYPE, None)

    def stop_motions(self) -> str:
        """Send all zeros, and repeat them for 1 s; return why they were not sent, or ''."""
        with self.lock:
            self.motor.forget_speed()       # so SPEED 0 is repeated
            if self.calibration:
                return ''       # the zeros were sent before it, and the board reads nothing
            self._begin_zeros()
            return self._stop() or ('the port takes no data' if self._stands else '')

    def _begin_zeros(self) -> None:
        self._zeros_until = dict.fromkeys(self._zeros, self._now() + REPEAT_FOR)
        self._zeros_at = 0.0

    def _moves(self, message: LayoutMessage) -> bool:
        """Whether it may make the board move something; of a custom command nobody knows."""
        return not (isinstance(message, _STILL) or wire.is_speed_0(message)
                    or self._zeros.get(message.TYPE) == message)

    def _stop_later(self, message: LayoutMessage) -> None:
        """If this is SPEED 0, which the port does not take: send it as soon as the port does. The
        heartbeat thread may not see that the port was blocked."""
        if wire.is_speed_0(message):
            self.motor.forget_speed()

    def _why_not(self, message: LayoutMessage, now: float) -> Tuple[str, str]:
        """Why the message cannot be sent now, in words, and as a cause; '' if it can."""
        link, calibrates = self._link, isinstance(message, wire.ImuCalibration)
        if self._has_ended:
            return 'the bridge is stopping', 'stopping'
        if message.ANNOUNCED:     # with the lock held, which `closed` takes before a next opening
            link.announcement.refuse_unless_current(f'{message}')
        if self.calibration:
            return _CALIBRATES, 'calibrating'
        if link.is_stopped and self._moves(message):
            return STOPPED, 'stopped'
        # A call counts as from a stall sooner than a topic's command, as on the bus.
        if self.motor.ignores_commands(now) or (
                calibrates and link.connection.may_be_from_a_stall()):
            return _STALLED, 'stall'
        if self.is_held:
            return ('the board is silent, so the other side of the pseudo terminal may hold it '
                    'back', 'silent')
        if self._stands:
            return 'the port takes no data', 'busy'
        if min(self._port.backlog(), self._line.waiting(now)) > _LONGEST_BURST:
            return 'the line has not sent the commands before it', 'busy'
        return '', ''

    def send_what_is_due(self, heartbeat_due: bool) -> bool:
        """In the heartbeat thread: send SPEED 0 if it is due, then a heartbeat if it is due.

        Returns whether a heartbeat was sent.
        """
        with self.lock:
            now = self._now()       # read with the lock held: the bridge may stall while it waits
            self._check_for_stall(now)
            self.motor.awake(now)
            if not self._port.is_open:
                self._watch.restart(now)     # any thread may be the first to write when it opens
            if self._has_ended or not self._port.is_open:
                return False
            try:
                self._drop_backlog_if_blocked(now)
                # The board reads nothing while it calibrates. But if IMU data is still received,
                # the line may have lost the request to calibrate and the SPEED 0 before it.
                calibration = self.calibration      # the link's thread may set it to None
                why = self.motor.due(now, calibration is None or calibration.data_goes_on(now))
                if why:
                    self._send(_SPEED_0, now)
                if why is Stop.TIMED_OUT:
                    self._log.warn('speed timeout', 'no speed command for '
                                   f'{self._speed_timeout:g} s: sent SPEED 0')
                if calibration is None:
                    self._send_zeros(now)
                if heartbeat_due:
                    now = self._now()       # the bridge may have stalled since
                    self._check_for_stall(now)
                    self._send(_HEARTBEAT, now)
                    self._beat_at = now
                return heartbeat_due
            except PortBusy:
                self._drop_backlog()    # so the next packet is SPEED 0, not a heartbeat
            except PortError:
                pass                    # the link's thread gets it, too, and handles it
            return False

    def send_speed_0(self) -> None:
        """Send SPEED 0 if the port takes it; without heartbeats the board stops its motor anyway.
        """
        with self.lock:
            self._stop()

    def end(self) -> None:
        """Send SPEED 0, and nothing after it: the heartbeat thread may outlive the wait for it."""
        with self.lock:
            self._has_ended = True
            self._drop_backlog_if_blocked(self._now(), _LONGEST_WAIT_AT_END)
            self._stop()
        self._port.drain(_LAST_STOP_TIME)     # closing it may drop what has not left

    def let_go(self, why: str, resets: bool = False) -> None:
        """Send SPEED 0, and nothing after it until the port is opened again; Refused while the
        board calibrates, unless it is reset then."""
        with self.lock:
            if self.calibration is not None and not resets:
                raise Refused(f'not now: {_CALIBRATES}', 'calibrating')
            self._drop_backlog_if_blocked(self._now(), _LONGEST_WAIT_AT_END)
            self._stop()
            self._port.give_up(why)
        self._port.drain(_LAST_STOP_TIME)     # closing it may drop what has not left

    def hold(self, is_held: bool) -> None:
        """Refuse commands, or accept them again, and drop what waits."""
        with self.lock:
            if not self._has_ended:     # else it would drop the last SPEED 0
                self._drop()     # also at the end of the silence: the heartbeats that waited
            self.is_held = is_held

    def opened(self) -> None:
        """The port was opened: the board may hold a motion, which ~stop stops."""
        with self.lock:
            if self._link.is_stopped:
                self._begin_zeros()

    def closed(self) -> None:
        """The port was closed; when it opens again, any thread may be the first to write."""
        with self.lock:
            if self.motor.moving and not self._has_ended:
                self._log.warn('moved', 'the port closed while the car may have been moving: '
                               'SPEED 0 is sent first when it is open again')
            self.motor.forget_speed()
            self._cut_off = True        # closing may have cut a packet
            self.is_held = self._stands = False

    def altered(self) -> None:
        """What was sent may have been changed on the way."""
        with self.lock:
            self.motor.forget_speed()
            self._cut_off = True

    # -- the caller holds the lock ------------------------------------------------------

    def _send(self, message: LayoutMessage, now: float) -> None:
        """Write one packet, and SPEED 0 before it while the board's speed is unknown.

        Raises:
            PortBusy, PortError: the packet was not sent, but SPEED 0 may have been.
            Refused: likewise; the bridge has stalled since `now`, when it was allowed.
        """
        if self.motor.speed_unknown and not wire.is_speed_0(message):
            self._send(_SPEED_0, now)
        if message is _HEARTBEAT and not (self._link.tap or self._cut_off):
            # A shortcut for the most frequent packet while no `tap` gets it.
            self._write(_HEARTBEAT_PACKET, message, now)
            self._link.frames_sent += 1
            return
        data = message.pack()
        self._send_heartbeat_before(message, len(data) + _OVERHEAD, now)
        packet = wire.encode_raw(message.TYPE, data)
        # After a packet that was cut off, a 0x00 ends the part that the board has received.
        packet = b'\0' + packet if self._cut_off else packet
        if self._now() > now + STALL and not (message is _HEARTBEAT or wire.is_speed_0(message)):
            raise Refused(f'{message} refused: {_STALLED}', 'stall')
        self._write(packet, message, now)
        self._cut_off = False
        if isinstance(message, wire.SpeedCommand):
            self.motor.sent(message.value, now)    # before anything that may raise
        self._link.written(packet, message.TYPE, 0, data, message)

    def _send_heartbeat_before(self, message: LayoutMessage, size: int, now: float) -> None:
        """Send a heartbeat, if its thread runs, where so many bytes would delay the next one."""
        if message is _HEARTBEAT or self.motor.speed_unknown or \
                not self._line.delays_heartbeat(size, now) or self._now() > self._beat_at + _BEATS:
            return
        self._send(_HEARTBEAT, now)
        self.extra_beats += 1

    def _write(self, packet: bytes, message: LayoutMessage, now: float) -> None:
        self._port.write(packet)
        self._watch.written += len(packet)
        self._line.wrote(len(packet), now)
        if message is _HEARTBEAT:
            self._line.wrote_heartbeat()

    def _stop(self) -> str:
        """Send SPEED 0, and the other zeros that are due; return why that failed, or ''."""
        try:
            try:
                self._send(_SPEED_0, self._now())
            except PortBusy:        # what waits is older, and may be a speed
                self._drop_backlog()
                self._send(_SPEED_0, self._now())
            self._send_zeros(self._now())
        except (PortBusy, PortError) as error:
            return str(error)
        except Exception as error:  # pylint: disable=broad-except
            self._log.warn('fault', traceback.format_exc())
            return f'{error!r}'
        return ''

    def _send_zeros(self, now: float) -> None:
        if not self._zeros_until or now < self._zeros_at:
            return
        self._zeros_at = now + REPEAT_PERIOD - EARLY
        for type_, until in list(self._zeros_until.items()):
            zero = self._zeros[type_]
            if now > until:
                del self._zeros_until[type_]
            elif not zero.ANNOUNCED or self._link.announcement.is_current:
                self._send(zero, now)

    def _check_for_stall(self, now: float) -> None:
        # If the link's thread stalls, so do the threads that receive commands: all have the same
        # priority.
        seconds = self.motor.detect_stall(now, self._link.connection.stalls.awake_at)
        if seconds is not None:
            self._log.warn('stall', f'the bridge stalled for {seconds:.3g} s: SPEED 0 is sent '
                           'first, and commands from that time are dropped')

    def _drop_backlog_if_blocked(self, now: float, longest: float = LONGEST_WAIT) -> None:
        """Do that if bytes wait in the port for so much longer than the line needs for them."""
        waited = self._watch.waiting_for(now)
        if self._port.is_network:
            longest = _LONGEST_WAIT_NETWORK
        if waited > longest + self._line.waiting(now):
            self._drop_backlog()
        elif not waited and self._watch.has_sent:
            self._stands = False

    def _drop_backlog(self) -> None:
        """Drop the output that waits in a blocked port, so that no old command reaches the
        board."""
        self._stands = True
        self._log.warn('blocked', 'the port takes no data: ' + (
            'the output that waited is dropped' if self._drop() else 'the connection is closed')
                       + ', and the board stops its motor')

    def _drop(self) -> bool:
        """Drop what was written but not sent; return whether the port is still usable."""
        self.motor.forget_speed()
        self._cut_off = True
        self._watch.restart(self._now())
        self._line.restart()
        return self._port.discard_output()
