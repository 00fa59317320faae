/**
 * The connection to the panel; session.py describes its messages. It reconnects by itself. It also
 * keeps the panel's clock, `now`, which continues while no update is received: therefore the ages
 * shown are correct even if the network delays updates.
 *
 * The token in the address that the panel prints stays in this browser's storage for this host and
 * port; a cookie would be sent to every port of the host.
 */
const PROTOCOL = 'panel';
const KEY = 'key';         // its name in the storage
const SILENCE = 1.0;       // s without an update, after which the connection counts as lost
const GIVE_UP = 4.0;       // s without an update, after which a new connection is tried
const RETRY = [0.3, 2.0];  // s between two tries: first, longest
const HIDDEN = 60.0;       // s for which a hidden tab stays connected
const DRIFT = 0.0005;      // s by which the two clocks may drift apart in a second

const seconds = () => performance.now() / 1000;

export class Connection extends EventTarget {
  constructor() {
    super();
    this.seen = 0;             // `now` of the latest update
    this.words = 'connecting …';
    this._offset = Infinity;   // this clock minus the panel's, with the network's shortest delay
    this._receivedAt = -Infinity;
    this._retry = RETRY[0];
    this._nextTry = Infinity;  // until the token in the address has been checked
    this._hiddenAt = null;
    this._refusal = '';        // why the token in the address was refused
    this._watch = [];
    document.addEventListener('visibilitychange', () => this._visibility());
    window.addEventListener('hashchange', () => this._enter());
    this._enter();
    setInterval(() => this._check(), 100);
  }

  /** The panel's clock. */
  now() { return this.alive || this._offset !== Infinity ? seconds() - this._offset : 0; }

  /** Whether updates are received. */
  get alive() { return this.silence() < SILENCE; }

  /** Seconds since the latest update. */
  silence() { return seconds() - this._receivedAt; }

  /** Send a message with the time of the latest update seen; return whether it was sent. */
  send(message) {
    if (this._socket?.readyState !== WebSocket.OPEN) return false;
    this._socket.send(JSON.stringify({seen: this.seen, ...message}));
    return true;
  }

  /** Subscribe to these topics. */
  watch(topics) {
    this._watch = [...topics];
    this.send({watch: this._watch});
  }

  /** Connect; first have the token in the address checked, if there is one, and keep it. */
  async _enter() {
    const token = location.hash.slice(1);
    if (token) {
      history.replaceState(null, '', location.pathname);    // out of the address bar
      try {
        const answer = await fetch('key', {method: 'POST', body: token});
        const words = await answer.text();
        if (answer.ok) localStorage.setItem(KEY, words);
        this._refusal = answer.ok ? '' : words;
      } catch { /* not reached: the token of an earlier address may do */ }
    }
    if (!this._socket) this._open();
  }

  _open() {
    const key = localStorage.getItem(KEY);
    const socket = new WebSocket(`${location.protocol.replace('http', 'ws')}//${location.host}/socket`,
      key ? [PROTOCOL, key] : [PROTOCOL]);
    this._socket = socket;
    this._nextTry = seconds() + GIVE_UP;
    socket.onopen = () => this.send({watch: this._watch});
    socket.onmessage = (event) => {
      if (socket === this._socket) this._take(JSON.parse(event.data));
    };
    socket.onclose = (event) => {
      if (socket === this._socket) this._closed(event.reason);
    };
  }

  _take(update) {
    const at = seconds();
    if (update.now < this.seen) this._offset = Infinity;   // the panel's machine has been restarted
    this._offset = Math.min(this._offset + DRIFT * Math.min(at - this._receivedAt, 1), at - update.now);
    this._receivedAt = at;
    this._retry = RETRY[0];
    this._refusal = '';
    this.seen = update.now;
    this.send({});
    this.dispatchEvent(new CustomEvent('update', {detail: update}));
  }

  _closed(reason) {
    this._socket = null;
    this._receivedAt = -Infinity;
    this.dispatchEvent(new Event('lost'));
    if (this._hiddenAt !== null) return;
    this.words = reason || this._refusal || 'the connection was lost';
    this._nextTry = seconds() + this._retry;
    this._retry = Math.min(this._retry * 1.6, RETRY[1]);
    this._findReason();
  }

  /** Ask for the reason why the page cannot connect: a WebSocket that is refused does not say. */
  async _findReason() {
    try {
      const key = localStorage.getItem(KEY);
      const answer = await fetch('key', {cache: 'no-store', headers: key ? {'X-Key': key} : {}});
      const words = await answer.text();
      if (!answer.ok) this.words = this._refusal || words;
    } catch {
      this.words = 'the panel does not answer';
    }
  }

  _check() {
    if (this._hiddenAt !== null && seconds() - this._hiddenAt > HIDDEN) {
      this._socket?.close();
      return;
    }
    if (this._socket && seconds() - Math.max(this._receivedAt, this._nextTry - GIVE_UP) > GIVE_UP) {
      const socket = this._socket;
      this._closed('');
      socket.close();
    }
    if (!this._socket && seconds() > this._nextTry) this._open();
  }

  _visibility() {
    this._hiddenAt = document.hidden ? seconds() : null;
    if (!document.hidden && !this._socket && this._nextTry < Infinity) this._open();
  }
}
