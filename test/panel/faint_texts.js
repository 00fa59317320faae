// The texts with a contrast below 4.5 (WCAG AA). Links are shown in the given health.
const health = arguments[0];
document.querySelectorAll('.link').forEach(e => { e.dataset.health = health; });
const canvas = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
const rgba = (colour) => {
  canvas.clearRect(0, 0, 1, 1); canvas.fillStyle = colour; canvas.fillRect(0, 0, 1, 1);
  return [...canvas.getImageData(0, 0, 1, 1).data];
};
const behind = (e) => {
  for (; e; e = e.parentElement) {
    const found = rgba(getComputedStyle(e).backgroundColor);
    if (found[3] === 255) return found;
  }
  return rgba('white');
};
const light = ([r, g, b]) => [r, g, b].map(v => v / 255).map(v => v <= 0.04045 ? v / 12.92
  : ((v + 0.055) / 1.055) ** 2.4)
  .reduce((sum, v, at) => sum + v * [0.2126, 0.7152, 0.0722][at], 0);
const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), faint = [];
while (texts.nextNode()) {
  const e = texts.currentNode.parentElement, text = texts.currentNode.textContent.trim();
  if (!text || !e.checkVisibility() || e.closest('.visually-hidden, :disabled')) continue;
  const [a, b] = [light(rgba(getComputedStyle(e).color)), light(behind(e))];
  const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  if (contrast < 4.5) faint.push(`${contrast.toFixed(2)} ${e.className} ${text.slice(0, 40)}`);
}
return faint;
