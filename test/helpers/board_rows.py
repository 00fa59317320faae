"""Reads rows as the built-in boards read those of their parameters."""
from functools import partial

from serial_communication.boards import arduino, bus, mcu

car_messages = partial(arduino.DESCRIPTION.read, 'messages')
car_settings = partial(arduino.DESCRIPTION.read, 'settings')
mcu_messages = partial(mcu.DESCRIPTION.read, 'messages')
mcu_settings = partial(mcu.DESCRIPTION.read, 'settings')
functions = partial(bus.DESCRIPTION.read, 'functions')
