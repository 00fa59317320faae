/** Elements, and numbers as text. Text from boards and topics becomes text nodes, never markup. */

/** Create an element with attributes (`class`, `onclick` …) and children (elements or text). */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith('on')) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, '');
    else if (value !== false && value !== null) element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

/** Create a card: a section with a heading, which is also its name for screen readers. */
export function card(title, note, ...children) {
  const id = 'card-' + title.toLowerCase().replace(/[^a-z0-9]+/g, '-');
  return h('section', {class: 'card', id, 'aria-labelledby': id + '-title'},
    h('header', {class: 'card-head'}, h('h2', {id: id + '-title'}, title),
      h('span', {class: 'note'}, note)),
    ...children);
}

/** Set the text if it has changed. Otherwise the browser need not lay out the page again. */
export function updateText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Set an attribute, or remove it (null, false), if it has changed. */
export function updateAttribute(element, name, value) {
  if (value === null || value === false) {
    if (element.hasAttribute(name)) element.removeAttribute(name);
  } else {
    const text = value === true ? '' : String(value);
    if (element.getAttribute(name) !== text) element.setAttribute(name, text);
  }
}

// A Map, since an announced unit may have any name, such as `constructor`.
const UNITS = new Map([['deg', '°'], ['degrees C', '°C'], ['m/s^2', 'm/s²'], ['in 10 ms', '/10 ms']]);

export const unit = (name) => UNITS.get(name) ?? name;

/** A value as text. The minus sign U+2212 is as wide as a plus sign; a hyphen is not. */
export function formatNumber(value, digits = null) {
  if (typeof value === 'boolean') return value ? 'yes' : 'no';
  if (typeof value === 'string') return value;
  if (value === null || value === undefined || Number.isNaN(value)) return '–';
  if (!Number.isFinite(value)) return value > 0 ? '∞' : '−∞';
  let text = digits !== null ? value.toFixed(digits)
    : String(Number.isSafeInteger(value) ? value : Number(value.toPrecision(6)));
  if (Number(text) === 0) text = text.replace('-', '');
  return text.replace('-', '−');
}

/** An age in s as a short text. */
export function formatAge(seconds) {
  if (seconds < 120) return `${seconds < 10 ? seconds.toFixed(1) : seconds.toFixed(0)} s`;
  return seconds < 7200 ? `${Math.floor(seconds / 60)} min` : `${Math.floor(seconds / 3600)} h`;
}

/** A text whose ages are left out, so that it changes only if what it says does. */
export const withoutAges = (text) => text.replace(/ for [\d.]+ (s|min|h)\b/g, '');

/** A name whose end stays visible where there is no room for its middle. */
export function shortened(text, end = 12) {
  const at = Math.max(0, text.length - end);
  return [h('span', {class: 'begin'}, text.slice(0, at)), h('span', {class: 'end'}, text.slice(at))];
}

/** A colour of the style sheet, for a canvas; cached until light or dark mode changes. */
const colours = new Map();
export function colour(name) {
  if (!colours.has(name)) {
    colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  }
  return colours.get(name);
}
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => colours.clear());

/** The context of a canvas, cleared and scaled to CSS pixels; null while it is not shown. */
export function context(canvas) {
  const {clientWidth: width, clientHeight: height} = canvas;
  if (!width || !height) return null;
  const ratio = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const ctx = canvas.getContext('2d');
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  ctx.clearRect(0, 0, width, height);
  return {ctx, width, height};
}
