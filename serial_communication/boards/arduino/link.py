"""The link to the model car: takes commands, sends heartbeats, receives measurements."""
import logging
from typing import Any, Callable, Iterable, Optional, Type

from ...framing.layout import LayoutMessage
from ...link.link import Link
from ...link.outcome import Refused
from ...link.sparing_log import SparingLog
from ...transport.pace import clock
from ...transport.port import Port
from . import wire
from .session import CarOptions, CarSession

_LABEL = 30     # characters of a message in a refusal


class ArduinoLink(Link):
    """Takes commands from any thread; each is sent at once, or refused.

    Args:
        messages, on_message, on_log, on_calibrating: as for `CarSession`.
        link_arguments: those of `Link`.
    """

    session: CarSession

    def __init__(self, port: Port, options: CarOptions = CarOptions(),
                 on_message: Callable[[Any, Any], None] = lambda message, stamp: None,
                 on_log: Callable[[int, str], None] = lambda severity, text: None,
                 on_calibrating: Callable[[bool], None] = lambda on: None,
                 messages: Iterable[Type[LayoutMessage]] = (),
                 logger: Optional[logging.Logger] = None,
                 now: Callable[[], float] = clock, **link_arguments: Any) -> None:
        log = SparingLog('arduino', logger or logging.getLogger(__name__), clock=now)
        super().__init__(port, CarSession(log, options, on_message, on_log, on_calibrating,
                                          messages, 10.0 / port.baud, now),
                         now=now, **link_arguments)

    def set_speed(self, value: int) -> None:
        """Send a speed, the PWM of the drive motor, saturated to -1000 … 1000; see `command`."""
        limit = wire.SPEED_LIMIT
        if not -limit <= value <= limit:
            saturated = limit if value > 0 else -limit
            self.log.warn('saturated', f'speed {value} is out of range (-{limit} … {limit}), '
                          f'sent {saturated}')
            value = saturated
        self.command(wire.SpeedCommand(value))

    def set_steering(self, value: int) -> None:
        """Send the PWM of the steering servo in µs, 0 … 65535; see `command`."""
        self.command(wire.SteeringCommand(value))

    def set_led(self, text: str) -> None:
        """Send an LED command: left, right, brake, disable …; at most 30 ASCII characters; see
        `command`."""
        self.command(wire.LedCommand(text))

    def calibrate_imu(self) -> None:
        """Send IMU_CALIBRATION, after all zeros; see `command`.

        Commands are refused until the calibration is over (see `Calibration`): the board would
        read them minutes later, all at once.
        """
        self.command(wire.ImuCalibration())

    def command(self, message: LayoutMessage, stamp: Any = None) -> None:
        """Send a message; Refused for a value out of range, or if it cannot be sent now.

        Args:
            stamp: of its making, by the clock of the stamps; None: unknown.
        """
        try:
            self.writer.submit(message, stamp)
        except Refused as refused:
            raise Refused(f'{f"{message}"[:_LABEL]} refused: {refused}', refused.cause) from None

    def add_motion(self, zero: LayoutMessage) -> None:
        """What this message ends is a motion: a row that moves something."""
        self.session.add_motion(zero)

    def remove_motion(self, zero: LayoutMessage) -> None:
        """Undo `add_motion`; the motion is ended before."""
        with self.session.lock:
            self.writer.transmit(self.session.remove_motion(zero, self.now()), self.now())
