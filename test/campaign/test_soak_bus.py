"""What callers were told against what the board did, sound and doctored."""
from campaign.check_bus import check_bus

TIMEOUTS = {'lift': 0.5, 'gimbal': 0.5, 'raw': 0.3}
LIFT = {'cmd1': 0x55, 'cmd2': 0x20}
RAW = {'cmd1': 0x55, 'cmd2': 0xF0}
SUCCESS, REFUSED, NOT_SENT, TIMEOUT = 2, 3, 253, 254


def call(t0, data, status, took=0.01, kind='lift', **more):
    record = dict(LIFT if kind == 'lift' else RAW, kind=kind, data=data, t0=t0, t1=t0 + took,
                  status=status, success=status == SUCCESS, error=0, message='')
    if kind == 'raw':
        record['reply'] = data if status == SUCCESS else ''
    record.update(more)
    return record


def executed(t, data, kind='lift', **more):
    return dict(LIFT if kind == 'lift' else RAW, t=t, ev='executed', data=data, text=data, **more)


def violations(calls, journal, blind=()):
    rows = check_bus(calls, journal, list(blind), TIMEOUTS)
    return [len(row.violations) for row in rows]


NONE = [0] * 8
ONCE, NOT, AT_MOST, TWICE, NOBODY, WRONG, ANSWERED, _BLIND = range(8)


def only(*which):
    return [1 if index in which else 0 for index in range(8)]


def test_success_executed_once():
    assert violations([call(1.0, '0005', SUCCESS)], [executed(1.005, '0005')]) == NONE


def test_success_not_executed():
    assert violations([call(1.0, '0005', SUCCESS)], []) == only(ONCE)


def test_success_executed_twice():
    journal = [executed(1.005, '0005'), executed(1.007, '0005')]
    assert violations([call(1.0, '0005', SUCCESS)], journal) == only(ONCE, TWICE)


def test_refused_executed():
    assert violations([call(1.0, '0005', REFUSED)], [executed(1.005, '0005')]) == only(NOT)


def test_not_sent_executed():
    assert violations([call(1.0, '0005', NOT_SENT)], [executed(1.005, '0005')]) == only(NOT)


def test_timeout_executed_once_or_not():
    assert violations([call(1.0, '0005', TIMEOUT, 0.5)], []) == NONE
    assert violations([call(1.0, '0005', TIMEOUT, 0.5)], [executed(1.9, '0005')]) == NONE


def test_timeout_executed_twice():
    journal = [executed(1.005, '0005'), executed(1.4, '0005')]
    assert violations([call(1.0, '0005', TIMEOUT, 0.5)], journal) == only(AT_MOST, TWICE)


def test_executed_for_nobody():
    assert violations([], [executed(1.005, '0005')]) == only(NOBODY)


def test_executed_before_it_was_asked_for():
    assert violations([call(1.0, '0005', TIMEOUT)], [executed(0.5, '0005')]) == only(NOBODY)


def test_the_same_move_asked_for_again_much_later():
    calls = [call(1.0, '0005', SUCCESS), call(60.0, '0005', SUCCESS)]
    assert violations(calls, [executed(1.005, '0005'), executed(60.005, '0005')]) == NONE


def test_a_reply_of_somebody_else():
    journal = [executed(1.005, 'aa' * 8, 'raw')]
    assert violations([call(1.0, 'aa' * 8, SUCCESS, kind='raw', reply='bb' * 8)],
                      journal) == only(WRONG)


def test_too_late():
    journal = [executed(1.005, '0005')]
    assert violations([call(1.0, '0005', SUCCESS, 1.51)], journal) == only(ANSWERED)
    assert violations([call(1.0, '0005', SUCCESS, 1.49)], journal) == NONE


def test_never_answered():
    assert violations([call(1.0, '0005', SUCCESS, t1=None)], []) == only(ANSWERED)


def test_raised():
    assert violations([call(1.0, '0005', SUCCESS, exception='ServiceException')],
                      []) == only(ANSWERED)


def test_damage_made_another_request_of_it():
    """The board executed what nobody asked for and said OK: nobody can tell."""
    journal = [executed(1.005, '0007', genuine=False)]
    assert violations([call(1.0, '0005', SUCCESS)], journal) == NONE
    rows = check_bus([call(1.0, '0005', SUCCESS)], journal, [], TIMEOUTS)
    assert rows[-1].tries == 1 and not rows[-1].judged and '1 calls told wrong' in rows[-1].worst


def test_damage_at_another_time_excuses_nothing():
    journal = [executed(5.005, '0007', genuine=False)]
    assert violations([call(1.0, '0005', SUCCESS)], journal) == only(ONCE)


def test_damage_made_another_reply_of_it():
    assert violations([call(1.0, '0005', REFUSED)], [executed(1.005, '0005')], [1.006]) == NONE


def test_what_the_bridge_asks_of_its_own_is_no_callers():
    journal = [{'t': 1.0, 'ev': 'executed', 'cmd1': 1, 'cmd2': 0, 'data': '01020304', 'text': ''},
               {'t': 1.0, 'ev': 'executed', 'cmd1': 0, 'cmd2': 0, 'data': '', 'text': ''},
               {'t': 1.0, 'ev': 'executed', 'cmd1': 0x55, 'cmd2': 0x22, 'data': '', 'text': ''}]
    assert violations([], journal) == NONE
