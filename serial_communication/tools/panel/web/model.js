/** What the page knows of the bridge: the sum of all updates. */
const KEPT = 12000;         // samples of a topic: 10 min at the rate of the updates, 20 Hz
const MOST = 500;           // lines of the log, and frames
const GAP = 1;              // s; a slow page has fewer samples than the bridge sent
const MINUTE = 60;
const STATUS_PERIOD = 1;    // s between two statuses of a link
const SPECIAL = new Map([['nan', NaN], ['inf', Infinity], ['-inf', -Infinity]]);

/** One topic: its latest values, and columns of times and values for plots. */
export class Topic {
  constructor(name) {
    this.name = name;
    this.describe({type: '', fields: null, limit: null});
  }

  describe({type, fields, limit}) {
    const names = (fields ?? []).map(([name]) => name).join();
    if (names !== this._names) {
      this._names = names;
      this.columns = [[], ...(fields ?? []).map(() => [])];
      this.values = [];
    }
    Object.assign(this, {type, limit,
      fields: (fields ?? []).map(([name, unit, digits, low, high]) =>
        ({name, unit, digits, low, high}))});
  }

  /** Take a sample; `wall` makes its time one of the day. */
  take([at, ...values], wall) {
    const gap = this.limit !== null && at - this.at > Math.max(this.limit, GAP);
    this.at = at;
    this.values = values.map((each) => SPECIAL.get(each) ?? each);
    if (this.values.length !== this.fields.length) return;
    if (gap) this._append(at + wall - 1e-3, this.values.map(() => null));
    this._append(at + wall, this.values.map((each) =>
      Number.isFinite(Number(each)) && each !== '' ? Number(each) : null));
    if (this.columns[0].length < KEPT * 1.1) return;
    for (const each of this.columns) each.splice(0, each.length - KEPT);
  }

  _append(time, numbers) {
    this.columns[0].push(time);
    numbers.forEach((each, index) => this.columns[index + 1].push(each));
  }

  value(name) { return this.values[this.fields.findIndex((each) => each.name === name)]; }

  age(now) { return this.at === undefined ? Infinity : Math.max(0, now - this.at); }

  /** none (no value yet), stale or fresh. */
  state(now) {
    if (!this.values.length) return 'none';
    return this.limit !== null && this.age(now) > this.limit ? 'stale' : 'fresh';
  }
}

/** One link, as /diagnostics reports it. */
class Link {
  constructor(name) {
    Object.assign(this, {name, at: null, level: null, summary: '', values: {}});
    this._counts = [];      // [time, {cause: count}] of the last minute
  }

  take(status) {
    Object.assign(this, status ?? {});
    if (!status) return;
    const counts = new Map(Object.entries(status.values).filter(([key]) => key.endsWith(' errors'))
      .map(([key, count]) => [key.slice(0, -' errors'.length), Number(count)]));
    // A counter that is lower than before belongs to a bridge that was started again.
    const last = this._counts[this._counts.length - 1]?.[1];
    if ([...counts].some(([cause, count]) => count < last?.get(cause))) this._counts = [];
    this._counts.push([status.at, counts]);
    const old = this._counts.findIndex(([at]) => status.at - at < MINUTE) - 1;
    this._counts.splice(0, Math.max(0, old));
  }

  /** The errors of the last minute: [cause, count]. */
  errors() {
    const [, first] = this._counts[0] ?? [0, new Map()];
    const [, last] = this._counts[this._counts.length - 1] ?? [0, new Map()];
    return [...last].map(([cause, count]) => [cause, count - (first.get(cause) ?? 0)])
      .filter(([, count]) => count > 0);
  }

  stale(now) { return this.at === null || now - this.at > 3 * STATUS_PERIOD; }

  /** none (no status), ok, warn or error. */
  health(now) {
    return this.stale(now) ? 'none' : ['ok', 'warn', 'error'][Math.min(this.level, 2)];
  }
}

export class Model {
  constructor() { this._clear(); }

  _clear() {
    Object.assign(this,
      {control: false, node: '', trouble: '', titles: {}, forms: {}, drives: false});
    this.topics ??= new Map();      // kept over a lost connection, for the plots
    this.links = new Map();
    this.log = [];
    this.frames = [];
    this.calls = new Map();         // by number
  }

  take(update) {
    if ('control' in update) {      // the first update of a connection has the whole state
      this._clear();
      this.control = update.control;
    }
    const {topics, ...state} = update.state ?? {};
    Object.assign(this, state);
    if (topics) {
      for (const name of this.topics.keys()) if (!(name in topics)) this.topics.delete(name);
      for (const [name, described] of Object.entries(topics)) {
        if (!this.topics.has(name)) this.topics.set(name, new Topic(name));
        this.topics.get(name).describe(described);
      }
    }
    for (const [name, sample] of Object.entries(update.samples ?? {})) {
      this.topics.get(name)?.take(sample, update.wall);
    }
    for (const [name, status] of Object.entries(update.links ?? {})) {
      if (!this.links.has(name)) this.links.set(name, new Link(name));
      this.links.get(name).take(status);
    }
    this.log.push(...Object.values(update.log ?? {}));
    this.frames.push(...Object.values(update.frames ?? {}));
    for (const call of Object.values(update.calls ?? {})) this.calls.set(call.number, call);
    for (const list of [this.log, this.frames]) list.splice(0, list.length - MOST);
    for (const number of this.calls.keys()) if (this.calls.size > 30) this.calls.delete(number);
  }

  /** Whether STOP holds: by /diagnostics, unless ~stop was answered less than a status before. */
  stopped(now) {
    const links = [...this.links.values()].filter((link) => !link.stale(now));
    let at = Math.max(...links.map((link) => link.at));
    let held = links.some((link) => link.values.condition === 'stopped');
    for (const {name, outcome, began, took, values} of this.calls.values()) {
      const until = began + took + STATUS_PERIOD;
      if (name === '~stop' && outcome === 'done' && until > at) [at, held] = [until, values.data];
    }
    return links.length > 0 && held;
  }

  /** Why a command that needs this link cannot be carried out now; '' if it can. */
  whyNot(name, now) {
    if (this.trouble) return this.trouble;
    const link = this.links.get(name), condition = link?.values.condition;
    if (!link || link.stale(now)) return `the ${name} link has no status`;
    return ['closed', 'lent', 'silent', 'calibrating'].includes(condition)
      ? `${name}: ${link.summary}` : '';
  }
}
