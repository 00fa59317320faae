/** Places cards in as many columns as fit, each in the column that is shortest so far. */
const LEAST_WIDTH = 24;      // rem, of a column
const GAP = 1;               // rem

/**
 * @param cards returns them in the order of importance
 * @param busy whether nothing may move now: a card under the pointer must stay where it is
 * @returns a function that places the cards again, if others are shown
 */
export function flow(place, cards, busy) {
  const columns = [];
  let rem = 16, count = 0, shape = '';
  const arrange = () => {
    const wanted = `${count}: ${cards().filter((card) => !card.hidden).map((card) => card.id).join()}`;
    if (wanted === shape || busy() || !count) return;
    shape = wanted;
    while (columns.length < count) columns.push(place.appendChild(document.createElement('div')));
    while (columns.length > count) columns.pop().remove();
    columns.forEach((column) => { column.className = 'column'; });
    const heights = columns.map(() => 0), focused = document.activeElement;
    for (const card of cards()) {
      const at = heights.indexOf(Math.min(...heights));
      columns[at].append(card);
      if (!card.hidden) heights[at] += card.offsetHeight + GAP * rem;
    }
    focused?.focus({preventScroll: true});
  };
  new ResizeObserver(([{contentRect}]) => {
    rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
    count = Math.max(1, Math.floor((contentRect.width / rem + GAP) / (LEAST_WIDTH + GAP)));
    arrange();
  }).observe(place);
  new MutationObserver(arrange).observe(place, {attributes: true, attributeFilter: ['hidden'], subtree: true});
  return arrange;
}
