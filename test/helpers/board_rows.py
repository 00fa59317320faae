"""Reads rows as the built-in boards read those of their parameters."""
from functools import partial

from serial_communication.boards import arduino, bus, mcu

car_messages = partial(arduino.DESCRIPTION.read, arduino.DESCRIPTION.groups[0])
car_settings = partial(arduino.DESCRIPTION.read, arduino.DESCRIPTION.groups[1])
mcu_messages = partial(mcu.DESCRIPTION.read, mcu.DESCRIPTION.groups[0])
mcu_settings = partial(mcu.DESCRIPTION.read, mcu.DESCRIPTION.groups[1])
functions = partial(bus.DESCRIPTION.read, bus.DESCRIPTION.groups[0])
