"""What all links share: the sparing log, counters, and faults that end no link."""


from steps import Steps
from links import ArduinoLink
from links import BusLink, McuLink
from serial_communication.link.sparing_log import SparingLog
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus

# For each link a frame that is valid at any time.
VALID = {BusLink: bus.encode_reply(bus.Reply(bus.SYNC, b'')),
         ArduinoLink: arduino.encode(arduino.Ticks(1)),
         McuLink: mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 1)}


def test_a_cause_is_logged_once_in_10_s_with_the_number_left_out(logger, lines):
    now = [0.0]
    log = SparingLog('bus', logger, clock=lambda: now[0])
    for tenth in range(0, 205):
        now[0] = tenth / 10
        log.warn('noise', 'noise again')
    assert lines() == ['bus: noise again', 'bus: noise again (and 99 more like it)',
                       'bus: noise again (and 99 more like it)']


def test_errors_are_counted_reported_and_logged_sparingly(logger, lines):
    steps = Steps(McuLink, timeout=20.0, logger=logger).run(0.1)
    valid = VALID[McuLink]
    invalid = valid[:-2] + bytes((valid[-2] ^ 1, 3))
    steps.give((invalid + b'noise') * 50 + valid)
    link, now = steps.link, steps.port.time
    report = link.report(now)
    values = dict(report.values)
    assert (values['checksum errors'], values['framing errors']) == (50, 50)
    assert (report.level, report.summary) == (1, '100 errors in the last second')
    assert link.report(now).level == 0
    assert len(lines('checksum: ')) == len(lines('framing: ')) == 1
    assert values['bytes received'] == 50 * (len(invalid) + 5) + len(valid)
    assert values['port'] == '/dev/none' and float(values['last frame age [s]']) < 20


def test_a_false_start_does_not_delay_frames_that_follow_without_a_pause(logger):
    """Its length of 255 would span sixteen frames, and no pause between them is long enough."""
    got = []
    steps = Steps(McuLink, logger=logger,
                  on_status=lambda message, seq, stamp: got.append(seq)).run(0.1)
    steps.give(bytes((mcu.STX, 255)))
    for seq in range(10):
        steps.give(mcu.encode(mcu.SensorStatus(400, 500, 1.0, 2.0, 3.0), seq), 0.04)
    assert got[0] == 0 and len(got) >= 5
