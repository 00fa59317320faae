/**
 * Whether the page has just appeared. Another site may open it under the pointer, between the two
 * clicks of a double click: for a second, a press is not meant for this page. A form that appears or
 * vanishes moves others under the pointer, too.
 */
const SETTLING = 1000;      // ms
let since = performance.now();

export const APPEARED = 'the page has just appeared';

/** The page or its controls appear now. */
export function appear() { since = performance.now(); }

export const hasJustAppeared = () => performance.now() - since < SETTLING;

window.addEventListener('focus', appear);
window.addEventListener('pageshow', appear);
document.addEventListener('visibilitychange', appear);
