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

/** Create a card: a section with a heading, and a note beside it. */
export function card(title, note, ...children) {
  return h('section', {class: 'card', 'aria-label': title},
    h('header', {}, h('h2', {}, title), h('span', {class: 'note'}, note)), ...children);
}

/** Set the text if it has changed. Otherwise the browser need not lay out the page again. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Set an attribute, or remove it (null, false), if it has changed. */
export function setAttribute(element, name, value) {
  if (value === null || value === false) {
    if (element.hasAttribute(name)) element.removeAttribute(name);
  } else if (element.getAttribute(name) !== String(value)) {
    element.setAttribute(name, String(value));
  }
}

// A Map, since an announced unit may have any name, such as `constructor`.
const UNITS = new Map([['deg', '°'], ['degrees C', '°C'], ['m/s^2', 'm/s²'],
  ['in 10 ms', '/10 ms']]);

export const unitOf = (name) => UNITS.get(name) ?? name;

/** A value as text. The minus sign U+2212 is as wide as a plus sign; a hyphen is not. */
export function formatNumber(value, digits = null) {
  if (typeof value === 'boolean') return value ? 'yes' : 'no';
  if (typeof value === 'string') return value;
  if (value === null || value === undefined || Number.isNaN(value)) return '–';
  if (!Number.isFinite(value)) return value > 0 ? '∞' : '−∞';
  let text = digits !== null ? value.toFixed(digits)
    : String(Number.isSafeInteger(value) ? value : Number(value.toPrecision(5)));
  if (Number(text) === 0) text = text.replace('-', '');
  return text.replace('-', '−');
}

/** An age in s as a short text. */
export function formatAge(seconds) {
  if (seconds < 120) return `${seconds < 10 ? seconds.toFixed(1) : seconds.toFixed(0)} s`;
  return seconds < 7200 ? `${Math.floor(seconds / 60)} min` : `${Math.floor(seconds / 3600)} h`;
}

/** A colour of the style sheet, for a canvas; cached until light or dark mode changes. */
const colours = new Map();
export const darkMode = matchMedia('(prefers-color-scheme: dark)');
export function colour(name) {
  if (!colours.has(name)) {
    document.head.style.color = `var(${name})`;
    colours.set(name, getComputedStyle(document.head).color);
  }
  return colours.get(name);
}
darkMode.addEventListener('change', () => colours.clear());
