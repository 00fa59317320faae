/**
 * The connection to the panel; pages.py describes its messages. It reconnects by itself, and keeps
 * the panel's clock, `now`, which continues while no update is received.
 */
const SILENCE = 1.0;    // s without an update, after which the connection counts as lost
const GIVE_UP = 4.0;    // s without an update, after which a new connection is tried
const RETRY = 0.7;      // s between two tries
const DRIFT = 0.001;    // s by which the two clocks may drift apart from one update to the next

const seconds = () => performance.now() / 1000;

export class Connection extends EventTarget {
  constructor() {
    super();
    this.words = 'connecting …';
    this._seen = 0;             // `now` of the latest update
    this._offset = Infinity;    // this clock minus the panel's, with the shortest delay
    this._receivedAt = -Infinity;
    this._triedAt = Infinity;   // until the token in the address has been exchanged
    this._refusal = '';         // why the token was refused
    window.addEventListener('hashchange', () => this._enter());
    this._enter();
    setInterval(() => this._check(), 100);
  }

  /** The panel's clock; 0 until it is known. */
  now() { return this._offset === Infinity ? 0 : seconds() - this._offset; }

  get alive() { return this.silence() < SILENCE; }

  /** Seconds since the latest update. */
  silence() { return seconds() - this._receivedAt; }

  /** Send a message; return whether that was possible. */
  send(message) {
    if (this._socket?.readyState !== WebSocket.OPEN) return false;
    this._socket.send(JSON.stringify(message));
    return true;
  }

  /** Connect; first exchange the token in the address, if there is one, for a cookie. */
  async _enter() {
    const token = location.hash.slice(1);
    if (token) {
      history.replaceState(null, '', location.pathname);    // out of the address bar
      try {
        const answer = await fetch('token', {method: 'POST', body: token});
        this._refusal = answer.ok ? '' : await answer.text();
      } catch { /* not reached: the cookie of an earlier token may do */ }
    }
    this._open();
  }

  _open() {
    this._socket?.close();
    const socket = new WebSocket(`${location.origin.replace('http', 'ws')}/socket`);
    this._socket = socket;
    this._triedAt = seconds();
    socket.onmessage = (event) =>
      { if (socket === this._socket) this._take(JSON.parse(event.data)); };
    socket.onclose = (event) => { if (socket === this._socket) this._closed(event.reason); };
  }

  _take(update) {
    if (update.refused) {
      this.dispatchEvent(new CustomEvent('refused', {detail: update.refused}));
      return;
    }
    const at = seconds();
    if (update.now < this._seen) this._offset = Infinity;   // the panel's machine was restarted
    this._offset = Math.min(this._offset + DRIFT, at - update.now);
    this._receivedAt = at;
    this._refusal = '';
    this._seen = update.now;
    this.send({seen: update.now});
    this.dispatchEvent(new CustomEvent('update', {detail: update}));
  }

  _closed(reason) {
    this._socket = null;
    this._receivedAt = -Infinity;
    this.words = this._refusal || reason || 'the panel does not answer';
    this.dispatchEvent(new Event('lost'));
  }

  _check() {
    const waited = seconds() - this._triedAt;
    if (this._socket && Math.min(this.silence(), waited) > GIVE_UP) {
      const socket = this._socket;
      this._closed('');
      socket.close();
    }
    if (!this._socket && waited > RETRY) this._open();
  }
}
