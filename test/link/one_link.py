"""A program with one link, which a test can suspend: one_link.py mcu|bus URL.

Prints `value N` for each published value and `log TEXT` for each log line. It ends when its
standard input ends, and prints `stale N` then, the number of dropped bytes.
"""
import logging
import sys

from serial_communication.boards.bus.link import BusLink, BusSettings
from serial_communication.boards.mcu.link import McuLink
from serial_communication.transport.port import Port


def print_line(text):
    print(text, flush=True)


class _Handler(logging.Handler):
    def emit(self, record):
        print_line('log ' + record.getMessage())


kind, url = sys.argv[1:]
logger = logging.getLogger('one link')
logger.addHandler(_Handler())
logger.setLevel(logging.INFO)
link = McuLink(Port(url), timeout=60.0, logger=logger, network_silence=0.0,
               on_status=lambda message, seq, stamp: print_line(
                   f'value {message.adc0 + message.adc1 * 65536}')) \
    if kind == 'mcu' else BusLink(
        Port(url), BusSettings(environment_period=0.05), logger=logger,
        on_environment=lambda reading, stamp: print_line(f'value {reading.smoke}'))
link.start()
sys.stdin.read()
link.stop()
link.join()
print_line(f'stale {link.connection.stale}')
