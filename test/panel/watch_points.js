// Notes what is under 20 points, which are the middles of controls, or places beside them. The lines
// of the log and of the wire are left out: they stay while they are pointed at.
const CONTROL = 'button, input, summary, a, [tabindex]';
const at = ([x, y]) => {
  const found = document.elementFromPoint(x, y)?.closest(CONTROL) ?? null;
  return found?.closest('.log, .frames') ? null : found;
};
const inside = [...document.querySelectorAll(CONTROL)].map((e) => e.getBoundingClientRect())
  .filter((box) => box.width && box.top > 0 && box.bottom < innerHeight)
  .map((box) => [box.left + box.width / 2, box.top + box.height / 2]);
const every = Math.max(1, inside.length / 15);
const points = Array.from({length: Math.min(15, inside.length)},
                          (_, index) => inside[Math.floor(index * every)]);
for (let row = 0; points.length < 20; row++) {
  points.push([innerWidth * (0.2 + 0.13 * row % 0.7), innerHeight * (0.15 + 0.17 * row % 0.8)]);
}
const first = points.map(at);
const name = (control) => control === null ? 'nothing'
  : control.closest('[data-service]')?.dataset.service + ' ' + control.textContent.slice(0, 20);
window.samples = 0;
window.moved = [];
window.healths = new Set();
clearInterval(window.watching);
// Answers are added meanwhile, and refusals, if the page drives beside the other one.
clearInterval(window.pressing);
window.pressing = setInterval(
  () => document.querySelector('[data-service="~lift"] button').click(), 3000);
window.watching = setInterval(() => {
  samples += 1;
  document.querySelectorAll('.link').forEach((card) => healths.add(card.dataset.health));
  points.forEach((point, index) => {
    const now = at(point);
    if (now !== first[index]) moved.push(`${name(first[index])} -> ${name(now)}`);
  });
}, 100);
