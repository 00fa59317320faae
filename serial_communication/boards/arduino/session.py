"""What may reach the model car, and when: commands, heartbeats, and zeros before them where needed;
and what its measurements mean.

Only this module, `motion` and `calibration` decide what may reach the motor.
"""
from typing import Any, Callable, Dict, Iterator, List, NamedTuple, Optional, Tuple

from ...framing.announcement import Chunk
from ...framing.layout import LayoutMessage
from ...framing.stream import SETTING, Frame
from ...link.outcome import NOT_ANNOUNCED, STOPPED
from ...link.session import OK, WARN, Condition, Packet, Refused, Session
from ...link.settings import BoardSettings
from ...link.sparing_log import SparingLog
from . import DESCRIPTION, LONGEST_GAP, wire
from .calibration import BACK, Calibration
from .motion import Heartbeats, Motion

_LONGEST_BURST = 0.05    # s of wire time that may wait; then more commands are refused
_LONGEST_SLEEP = 0.02    # s; a low heartbeat rate must not make a zero late
_CALIBRATES = 'the board calibrates its IMU, which takes minutes'
_RESET = 'the board was reset: the calibration is over'
_HEARTBEAT = Packet(wire.encode(wire.Heartbeat()), wire.Heartbeat.TYPE, 0, b'', wire.Heartbeat())
_STILL = wire.SteeringCommand.TYPE, wire.LedCommand.TYPE, SETTING    # what ~stop does not refuse
_OVERHEAD = 4            # bytes of a packet besides its data, at most


class CarOptions(NamedTuple):
    """Parameters of the session; times are in s."""

    heartbeat_rate: float = 100.0        # Hz
    speed_timeout: float = 0.5           # of each motion; 0: never
    calibration_timeout: float = 900.0   # after this time a calibration counts as over
    check_plausibility: bool = True
    network_silence: float = 1.5         # of a port that hides what it has not sent; 0: never


class CarSession(Session):
    """The session of one model car.

    Args:
        on_message: called in the link's thread with the (message, stamp) of each message except
            log messages, announcements and TIME.
        on_log: called in the link's thread with the (severity 0 … 3, text) of each log message.
        on_calibrating: called with True when a calibration begins, with False when it ends.
    """

    NAME = DESCRIPTION.name
    board_settings: BoardSettings
    BEATS = True
    ENDS_FRAME = DESCRIPTION.between

    def __init__(self, log: SparingLog, options: CarOptions = CarOptions(),
                 on_message: Callable[[Any, Any], None] = lambda message, stamp: None,
                 on_log: Callable[[int, str], None] = lambda severity, text: None,
                 on_calibrating: Callable[[bool], None] = lambda on: None) -> None:
        decoder = wire.Decoder(options.check_plausibility)
        super().__init__(decoder, log, options.network_silence)
        self.board_settings = BoardSettings(log, decoder, lambda: self.wake())
        self.heartbeats = Heartbeats(options.heartbeat_rate)
        self.calibration: Optional[Calibration] = None
        self._options = options
        self._on_message, self._on_log, self._on_calibrating = on_message, on_log, on_calibrating
        self._motions: Dict[int, Motion] = {}      # by type
        self.add_motion(wire.SpeedCommand(0))

    @property
    def reads(self) -> bool:    # type: ignore[override]
        return self.calibration is None

    # -- motions --------------------------------------------------------------------------

    def add_motion(self, zero: LayoutMessage) -> None:
        """What this message ends is a motion: a row that moves something."""
        with self.lock:
            self._motions[zero.TYPE] = Motion(zero, self._options.speed_timeout)

    def remove_motion(self, zero: LayoutMessage, now: float) -> List[Packet]:
        """Undo `add_motion`; return what ends the motion, if the board has it."""
        motion = self._motions.pop(zero.TYPE, None)
        if motion is None or motion.is_unknown or self.calibration:
            return []
        return self._packets([zero], now)

    def _moves(self, message: Any) -> bool:
        """Whether it may make the board move something; of a custom command nobody knows."""
        return message.TYPE not in _STILL and not self._is_zero(message)

    def _is_zero(self, message: Any) -> bool:
        motion = self._motions.get(message.TYPE)
        return motion is not None and motion.zero == message

    def _known(self) -> Iterator[Motion]:
        """The motions that the board is known to have."""
        for motion in self._motions.values():
            if not motion.zero.ANNOUNCED or self.announcement.is_current:
                yield motion

    # -- what is sent; the lock is held -----------------------------------------------------

    def submit(self, request: Any, now: float) -> List[Packet]:
        """Take a message."""
        reason = request.implausible()
        try:
            wire.encode(request)     # before any log line quotes a text that is too long
        except ValueError as error:
            reason = str(error)
        if reason:
            raise Refused(reason, 'value')
        calibrates = isinstance(request, wire.ImuCalibration)
        if request.ANNOUNCED and not self.announcement.is_current:
            raise Refused(NOT_ANNOUNCED, 'not announced')
        if self.calibration:
            raise Refused(_CALIBRATES, 'calibrating')
        if self.is_stopped and self._moves(request):
            raise Refused(STOPPED, 'stopped')
        ends = self._is_zero(request) and self._motions[request.TYPE].moves
        if self.line.free_at - now > _LONGEST_BURST and not ends:
            raise Refused('the line has not sent the commands before it', 'busy')
        zeros = [motion.zero for motion in self._known() if calibrates and motion.moves]
        return self._packets([*zeros, request], now)

    def may_be_old(self, request: Any) -> bool:
        return self._is_zero(request) or request.TYPE == SETTING

    def beat(self, now: float) -> Tuple[List[Packet], float]:
        # The board reads nothing while it calibrates. But if IMU data is still received, the line
        # may have lost the request to calibrate and the zeros before it.
        calibration = self.calibration      # the link's thread may set it to None
        reads = calibration is None or calibration.data_goes_on(now)
        ended = [motion for motion in self._known() if motion.due(now, reads)]
        for motion in ended:
            if motion.moves and not motion.is_unknown:
                self.log.warn(f'timeout {motion.zero.LABEL}', f'no {motion.zero.LABEL} command for '
                              f'{self._options.speed_timeout:g} s: sent its zero')
        packets = self._packets([motion.zero for motion in ended], now) if ended else []
        if self.heartbeats.pace.passed(now):
            packets.append(_HEARTBEAT)
        return packets, min(self.heartbeats.pace.due, now + _LONGEST_SLEEP)

    def due(self, now: float, is_drained: bool) -> Tuple[List[Packet], Optional[float]]:
        self.idle(now)
        if self.calibration:
            return [], None
        messages, due = self.board_settings.send(now, self.announcement.is_current)
        return self._packets(messages, now), due

    def stop(self, now: float, why: str = '') -> Tuple[List[Packet], str]:
        for motion in self._motions.values():
            motion.forget()       # so its zero is repeated
        if self.calibration and not why:
            return [], ''         # the zeros were sent before it, and the board reads nothing
        return self._packets([motion.zero for motion in self._known()], now), ''

    def _packets(self, messages: List[Any], now: float) -> List[Packet]:
        """Their packets, and before them the zeros of motions that are not known."""
        packets: List[Packet] = []
        ended = [message.TYPE for message in messages if self._is_zero(message)]
        first = [motion.zero for motion in self._known()
                 if motion.is_unknown and motion.zero.TYPE not in ended] if messages else []
        for message in first + messages:
            data = message.pack()
            # A heartbeat goes before what would delay the next one too much.
            if not self._is_zero(message) \
                    and self.heartbeats.is_late(self.line.sent_at(len(data) + _OVERHEAD, now)) \
                    and not self.heartbeats.is_overdue(now):
                packets.append(_HEARTBEAT)
            packets.append(Packet(wire.encode_raw(message.TYPE, data), message.TYPE, 0, data,
                                  message))
        return packets

    def sent(self, packet: Packet, now: float) -> None:
        message = packet.message
        if packet is _HEARTBEAT:
            self.heartbeats.count(now, self.line.free_at)
        elif packet.type in self._motions:
            self._motions[packet.type].sent(message, now)
        elif isinstance(message, wire.ImuCalibration):
            self.calibration = Calibration(now)
            self._on_calibrating(True)

    def not_sent(self, packet: Packet, why: str) -> None:
        if self._is_zero(packet.message):
            self._motions[packet.type].forget()

    # -- what happens -----------------------------------------------------------------------

    def begin(self, now: float, is_opening: bool) -> None:
        for motion in self._motions.values():
            motion.forget()
        self.board_settings.reset()
        self.heartbeats.begin(now)
        calibration = self.calibration      # the link's thread may set it to None
        if calibration:
            calibration.watch_again(now)

    def end(self, why: str, now: float) -> None:
        for motion in self._motions.values():
            motion.forget()         # any thread may be the first to write when it is open again
        self.heartbeats.begin(None)
        self.board_settings.reset()

    def received(self, frame: Frame, now: float) -> None:
        message = frame.message
        if frame.type < len(wire.LOGS):
            self._on_log(frame.type, message.value)
        elif isinstance(message, Chunk):
            self.announcement.add(message)
        elif frame.type == SETTING:
            self.board_settings.received(message, self.announcement.is_current)
        elif not isinstance(message, wire.Time):
            calibration = self.calibration      # a reset may set it to None
            if calibration and isinstance(message, wire.Imu):
                self._end_calibration(calibration.imu_data(now))
            if not self.announcement.holds_back(message):
                self._on_message(message, frame.stamp)

    def idle(self, now: float) -> Optional[float]:
        calibration, timeout = self.calibration, self._options.calibration_timeout
        if calibration and now >= calibration.began + timeout:
            self._end_calibration(f'the calibration did not end within {timeout:g} s; commands are '
                                  'accepted again; check the board')
        return None

    def was_reset(self) -> None:
        self._end_calibration(_RESET)

    def _end_calibration(self, why: str) -> None:
        """End the calibration, if there is one; '': it is not over."""
        if why and self.calibration:
            self.calibration = None
            if why in (BACK, _RESET):
                self.log.info('calibrated', why)
            else:
                self.log.warn('not calibrated', why)
            self._on_calibrating(False)

    # -- what it looks like -------------------------------------------------------------------

    def under_way(self, is_reset: bool = False) -> str:
        return _CALIBRATES if self.calibration and not is_reset else ''

    def talks(self, now: float) -> Optional[bool]:
        return None if self.calibration else super().talks(now)     # then it is silent for minutes

    def condition(self, now: float) -> Condition:
        found = super().condition(now)
        gap = self.heartbeats.recent_gap(now)
        if self.calibration:
            return Condition(WARN if found.level else OK, 'calibrating', 'calibrating the IMU')
        if gap <= LONGEST_GAP:
            return found
        return Condition(WARN, found.name, f'{found.summary}; heartbeat gap of {gap * 1e3:.1f} ms: '
                         'after 30 ms the board stops its motor')

    def values(self) -> List[Tuple[str, Any]]:
        return [('heartbeats sent', self.heartbeats.sent),
                ('heartbeat gap [ms]', f'{self.heartbeats.shown_gap * 1e3:.2f}'),
                ('heartbeat max gap [ms]', f'{self.heartbeats.max_gap * 1e3:.2f}'),
                *self.board_settings.values()]
