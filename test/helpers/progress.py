"""A pytest plugin: at least each 5 s a line that says what runs and how far it is; at the end the
line `N passed, N failed`."""
import threading
import time

import pytest

_EVERY = 5.0    # s
_WIDTH = 79     # columns


class Progress:
    """Counts the results and prints where the run is."""

    def __init__(self):
        self._began = time.monotonic()
        self._total = 0
        self._counts = {'passed': 0, 'failed': 0, 'skipped': 0}
        self._broken = set()    # files that cannot be imported
        self._running = {}      # the tests that run, and since when
        self._ended = threading.Event()

    def pytest_collection_finish(self, session):
        self._total = len(session.items)

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids):
        self._total = len(ids)

    def pytest_sessionstart(self):
        threading.Thread(target=self._print_again_and_again, daemon=True).start()

    def pytest_runtest_logstart(self, nodeid):
        self._running[nodeid] = time.monotonic()

    def pytest_runtest_logfinish(self, nodeid):
        self._running.pop(nodeid, None)

    def pytest_runtest_logreport(self, report):
        if report.when == 'call' or report.outcome != 'passed':
            self._counts[report.outcome] += 1

    def pytest_collectreport(self, report):
        if report.outcome == 'failed' and report.nodeid not in self._broken:    # one a worker
            self._broken.add(report.nodeid)
            self._counts['failed'] += 1

    def pytest_report_teststatus(self, report):
        counts = report.when == 'call' or report.outcome != 'passed'
        return report.outcome if counts else '', '', ''       # no dots

    def pytest_unconfigure(self):
        self._ended.set()
        print('\n' + self._results())

    def _results(self):
        counts = self._counts
        text = '{passed} passed, {failed} failed'.format(**counts)
        return text + (', {skipped} skipped'.format(**counts) if counts['skipped'] else '')

    def _print_again_and_again(self):
        while not self._ended.wait(_EVERY):
            seconds = int(time.monotonic() - self._began)
            names = [name.rpartition('test/')[2].replace('::', ' ')
                     for name in sorted(self._running, key=self._running.get)]
            runs = f'; runs: {names[0]}' if names else ''
            print(f'{seconds // 60}:{seconds % 60:02}  {self._results()} of '
                  f'{self._total or "…"}{runs}'[:_WIDTH], flush=True)
