"""Links of the built-in boards with their sessions, for tests."""
import logging

from serial_communication.boards.arduino import wire
from serial_communication.boards.arduino.session import CarOptions, CarSession
from serial_communication.boards.bus import link as bus
from serial_communication.boards.bus.call import MasterOptions
from serial_communication.boards.bus.session import MasterSession
from serial_communication.boards.mcu.session import SensorSession
from serial_communication.link.link import Link
from serial_communication.link.sparing_log import SparingLog
from serial_communication.transport.pace import clock

_LOGGER = logging.getLogger(__name__)
_OF_LINK = 'frame_timeout', 'clock', 'earlier', 'board_time'


class ArduinoLink(Link):
    """A link to the car; the arguments are those of `CarSession` and `Link`."""

    def __init__(self, port, options=CarOptions(), logger=_LOGGER, now=clock, messages=(),
                 **arguments):
        of_link = {name: arguments.pop(name) for name in _OF_LINK if name in arguments}
        super().__init__(port, CarSession(
            SparingLog('arduino', logger, clock=now), options, **arguments), now=now, **of_link)
        for message in messages:
            self.session.decoder.add_message(message)

    def command(self, message):
        self.writer.submit(message)

    def set_speed(self, value):
        self.command(wire.SpeedCommand(value))


class McuLink(Link):
    """A link to the sensor board; likewise."""

    def __init__(self, port, logger=_LOGGER, now=clock, **arguments):
        of_link = {name: arguments.pop(name) for name in _OF_LINK if name in arguments}
        super().__init__(port, SensorSession(SparingLog('mcu', logger, clock=now), now=now,
                                             **arguments), now=now, **of_link)


class BusLink(bus.BusLink):
    """A link to the control board, without polls; likewise."""

    def __init__(self, port, options=MasterOptions(), logger=_LOGGER, now=clock, **arguments):
        super().__init__(port, MasterSession(SparingLog('bus', logger, clock=now), options),
                         now=now, **arguments)
