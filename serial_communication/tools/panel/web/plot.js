/**
 * A moving plot of some fields of a topic, by uPlot. Dragging over it zooms in, which also stops
 * it; a double click, or the button of the page, lets it move again.
 */
import {colour, darkMode, formatNumber, h, setText, unitOf} from './dom.js';

const SPAN = 60;        // s that are shown
const LEAST = 60;       // px, of the height
const COLOURS = ['--line-1', '--line-2', '--line-3', '--line-4', '--line-5'];

export const MOST_CURVES = COLOURS.length;

const visible = new WeakSet();      // figures
const watcher = new IntersectionObserver((entries) => {
  for (const {target, isIntersecting} of entries) visible[isIntersecting ? 'add'
    : 'delete'](target);
});

/** The name of the vector or array that a field is part of; '' if it is none's. */
export const wholeOf = ({name}) => name.match(/^(.*)(?:[. ][xyzw]|\[\d+\])$/)?.[1] ?? '';

export class Plot {
  /** @param fields [{name, unit, digits, at}]: `at` is the column */
  constructor(topic, fields) {
    this._topic = topic;
    this._fields = fields;
    this._kept = null;      // the data while it stands
    this._place = h('div', {class: 'plot', title: 'drag: zoom; double click: go on'});
    const whole = fields.length > 1 ? wholeOf(fields[0]) : '';
    this._about = [whole, unitOf(fields[0].unit)].filter(Boolean).join(', ');
    this._words = h('span', {class: 'note'}, this._about);
    const keys = fields.map(({name}, index) => {
      const words = whole ? name.slice(whole.length).replace('.', '') : name;
      const key = h('span', {class: 'key'}, words);
      key.style.setProperty('--key', `var(${COLOURS[index]})`);
      return key;
    });
    this.element = h('figure', {}, h('figcaption', {}, ...keys, this._words), this._place);
    this._place.addEventListener('dblclick', () => this.hold(false));
    watcher.observe(this.element);
    new ResizeObserver(() => this._resize()).observe(this._place);
    darkMode.addEventListener('change', () => {
      this._plot?.destroy();
      this._plot = null;
    });
  }

  /** Stand still, keep the data, and show the `whole` of it; or move again. */
  hold(held, whole = true) {
    this._kept = held ? this._data().map((column) => column.slice()) : null;
    if (held) this._plot?.setData(this._kept, whole);
    this._point(null);
  }

  /** Draw the last seconds. */
  draw(end) {
    if (!visible.has(this.element) || !this._place.clientWidth) return;
    if (!this._plot) this._make();
    if (this._kept) return;
    this._plot.setData(this._data(), false);
    this._plot.setScale('x', {min: end - SPAN, max: end});
  }

  _data() { return [0, ...this._fields.map(({at}) => at)].map((at) => this._topic.columns[at]); }

  _make() {
    const [faint, grid] = [colour('--faint'), {stroke: colour('--grid'), width: 1}];
    const axis = {stroke: faint, grid, ticks: {show: false}, font: '11px system-ui, sans-serif'};
    this._plot = new uPlot({
      width: this._place.clientWidth, height: Math.max(LEAST, this._place.clientHeight),
      legend: {show: false}, padding: [6, 24, 0, 0],
      cursor: {drag: {x: true, y: false}, points: {size: 6}},
      scales: {y: {range: (_plot, low, high) => rangeOf(low, high, this._fields[0].digits ?? 3)}},
      axes: [{...axis, size: 18, space: 70, gap: 2, values: (_plot, ticks) =>
        ticks.map((each) => new Date(each * 1000).toTimeString().slice(0, 8))},
        {...axis, size: 44, gap: 3, space: 24,
          values: (_plot, ticks) => ticks.map((each) => formatNumber(each))}],
      series: [{}, ...this._fields.map((_field, index) =>
        ({stroke: colour(COLOURS[index]), width: 1.5, points: {show: false}}))],
      hooks: {
        setCursor: [(plot) => this._point(plot.cursor.idx)],
        setSelect: [(plot) => { if (plot.select.width) this.hold(true, false); }]},
    }, this._kept ?? this._data(), this._place);
  }

  /** Show the values under the pointer. */
  _point(index) {
    const values = (index ?? null) === null ? [] : this._fields.map(({digits}, at) =>
      formatNumber(this._plot.data[at + 1][index], digits));
    setText(this._words, values.join(', ') || (this._kept ? 'stands' : this._about));
  }

  _resize() {
    const {clientWidth: width, clientHeight: height} = this._place;
    if (this._plot && width) this._plot.setSize({width, height: Math.max(LEAST, height)});
  }
}

/** The limits of the axis: the data's, but at least a step of the last digit apart. */
function rangeOf(low, high, digits) {
  if (low === null || !Number.isFinite(high - low)) return [0, 1];
  const middle = (low + high) / 2;
  const half = Math.max(high - low, Math.abs(middle) * 1e-3, 10 ** -digits) / 2 * 1.15;
  return [middle - half, middle + half];
}
