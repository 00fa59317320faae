"""One link in a process of its own, so that a test can suspend it: one_link.py mcu|bus URL.

Prints a line for each value as it is published (`value N`) and for each line of the log (`log …`),
and `stale N` once its standard input ends, with which it ends.
"""
import logging
import sys

from serial_communication.boards.bus.link import BusLink, BusSettings
from serial_communication.boards.mcu.link import McuLink
from serial_communication.transport.port import Port


def say(text):
    print(text, flush=True)


class _Handler(logging.Handler):
    def emit(self, record):
        say('log ' + record.getMessage())


kind, url = sys.argv[1:]
logger = logging.getLogger('one link')
logger.addHandler(_Handler())
logger.setLevel(logging.INFO)
link = McuLink(Port(url), timeout=60.0, logger=logger, network_silence=0.0,
               on_status=lambda message, seq, stamp: say(
                   f'value {message.adc0 + message.adc1 * 65536}')) \
    if kind == 'mcu' else BusLink(
        Port(url), BusSettings(environment_period=0.05), logger=logger,
        on_environment=lambda reading, stamp: say(f'value {reading.smoke}'))
link.start()
sys.stdin.read()
link.stop()
link.join()
say(f'stale {link.stale}')
