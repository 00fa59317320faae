/** The inputs of a form: one for each field of a service's request or of a custom command. */
import {formatNumber, h, unit} from '../dom.js';

/** Inputs for these fields; `read()` returns the values by field, or null if one is not valid. */
export function makeInputs(fields) {
  const inputs = fields.map((field) => ({field, input: makeInput(field)}));
  return {
    elements: inputs.map(({field, input}) => isUsual(field)
      ? h('label', {class: 'amount'}, input, h('span', {}, unit(field.unit)))
      : h('label', {class: 'amount'}, `${field.name} `, input, h('span', {class: 'note'}, limits(field)))),
    read: () => inputs.every(({field, input}) => check(field, input))
      ? Object.fromEntries(inputs.map(({field, input}) => [field.name, valueOf(field, input)])) : null,
  };
}

/** Whether the field has a preset value, beside which its unit says enough. */
const isUsual = (field) => typeof field.preset === 'number';

function makeInput(field) {
  const {name, kind, whole, low, high} = field;
  if (kind === 'bool') return h('input', {type: 'checkbox', 'aria-label': name});
  const isNumber = kind === 'number';
  return h('input', {type: isNumber ? 'number' : 'text', size: '6',
    'aria-label': isUsual(field) ? `${name}: ${limits(field)}` : name, value: isUsual(field) ? field.preset : null,
    min: isNumber ? low : null, max: isNumber ? high : null, step: isNumber ? whole ? '1' : 'any' : null,
    inputmode: isNumber ? 'decimal' : null, required: isNumber});
}

/** The unit and the limits of a field as text. */
function limits({kind, low, high, unit: name}) {
  if (kind === 'bool') return '';
  const range = low === null && high === null ? '' : low === null ? `≤ ${formatNumber(high)}`
    : high === null ? `≥ ${formatNumber(low)}` : `${formatNumber(low)} … ${formatNumber(high)}`;
  const list = kind === 'array' ? 'numbers with spaces' : '';
  return [unit(name), range, list].filter((each) => each).join(', ');
}

/** Whether the input is valid; otherwise the browser shows why. An empty field is not 0. */
function check(field, input) {
  if (field.kind === 'array') {
    const numbers = valueOf(field, input);
    const wrong = numbers.some((each) => !Number.isFinite(each) || field.whole && !Number.isInteger(each)
      || field.low !== null && each < field.low || field.high !== null && each > field.high);
    input.setCustomValidity(wrong ? `Enter ${field.whole ? 'whole ' : ''}numbers: ${limits(field)}` : '');
  }
  return input.reportValidity();
}

function valueOf({kind}, input) {
  if (kind === 'bool') return input.checked;
  if (kind === 'array') return input.value.trim().split(/[\s,;]+/).filter((each) => each).map(Number);
  return kind === 'number' ? Number(input.value) : input.value;
}
