/** The page: its cards, their tabs on a phone, the topics they show, and when they are drawn. */
import {Air} from './cards/air.js';
import {Attitude, Battery, Motion} from './cards/car.js';
import {Commands} from './cards/commands.js';
import {Drive} from './cards/drive.js';
import {Links, worst} from './cards/links.js';
import {Log} from './cards/log.js';
import {TopicCards} from './cards/topics.js';
import {Wire} from './cards/wire.js';
import {appear} from './appeared.js';
import {Connection} from './connection.js';
import {formatAge, h, updateAttribute, updateText, withoutAges} from './dom.js';
import {flow} from './flow.js';
import {Model} from './model.js';
import {STOPPED} from './reasons.js';

const IDLE = 200;         // ms between two drawings while no update is received
const CLICK_OF_PRESS = 1000;    // ms after a press in which a click is the same press

const place = (id) => document.getElementById(id);
const announce = (words) => { place('announcer').textContent = words; };

const model = new Model();
const connection = new Connection();
const links = new Links(announce);
const topicCards = new TopicCards();
const commands = new Commands(connection, announce);
const drive = new Drive(connection);
const wire = new Wire(watch);
const log = new Log();
// The parts of the page; on a phone each is a tab. The links' card is in index.html.
const tabs = {
  Links: [log], Drive: [drive], Commands: [commands], Car: [new Attitude(), new Motion(), new Battery()],
  Sensors: [new Air()], Wire: [wire]};
const cards = [links, topicCards, ...Object.values(tabs).flat()];
const [attitude, ...car] = tabs.Car;
const elements = (...parts) => parts.map((each) => each.element);
const flowing = () => [...elements(attitude, drive, commands, ...car), ...topicCards.elements,
  ...elements(...tabs.Sensors, log)];
let shownTab = 'Links';

for (const [name, parts] of Object.entries(tabs)) parts.forEach((each) => { each.element.dataset.tab = name; });
place('below').append(wire.element);
const arrange = flow(place('columns'), flowing, () => drive.held);

/** Mark the cards of other tabs, which has an effect on a phone only. */
function markCards() {
  for (const element of [links.element, wire.element, ...flowing()]) {
    updateAttribute(element, 'data-elsewhere', element.dataset.tab !== shownTab);
  }
}

function showTab(name) {
  shownTab = name;
  markCards();
  for (const button of place('tabs').children) {
    updateAttribute(button, 'aria-pressed', String(button.textContent === name));
  }
  scrollTo(0, 0);
  requestAnimationFrame(draw);
}
place('tabs').append(...Object.keys(tabs).map((name) =>
  h('button', {type: 'button', onclick: () => showTab(name)}, name)));
// STOP is sent as soon as it is pressed. A touch may bring no click at all: a second finger, one that
// slips or one that stays. Only a key brings a click alone.
let stoppedAt = -Infinity;
place('stop').addEventListener('pointerdown', ({button}) => {
  if (button !== 0) return;
  stoppedAt = performance.now();
  commands.stop();
});
place('stop').addEventListener('click', () => {
  if (performance.now() - stoppedAt > CLICK_OF_PRESS) commands.stop();
});

function watch() {
  connection.watch(new Set(cards.flatMap((each) => each.topics)));
}

/** Show connection, STOP, the bridge's trouble and the worst link in the page's head and title. */
function drawHead(now) {
  const alive = connection.alive;
  const state = worst(model, now);
  const trouble = alive ? model.trouble
    : connection.seen ? `no connection to the panel for ${formatAge(Math.max(0, now - connection.seen))}: ${connection.words}` : connection.words;
  const stopped = model.stopped(now), stopTrouble = commands.stopTrouble(model, now);
  const words = [stopTrouble, trouble, stopped ? STOPPED : ''].filter(Boolean).join('; ');
  place('trouble').hidden = !words || !connection.seen && connection.words === 'connecting …';
  updateText(place('trouble'), words);
  updateAttribute(place('trouble'), 'title', words);
  updateAttribute(place('trouble'), 'data-stopped', words === STOPPED);
  const health = !alive ? 'lost' : trouble ? 'trouble' : 'live';
  updateText(place('connection'), {lost: 'no connection', trouble: 'not live', live: 'live'}[health]);
  updateAttribute(document.body, 'data-connection', health);
  updateText(place('alarm'), place('trouble').hidden ? '' : withoutAges(words));
  place('stop').hidden = model.controls === null;
  updateAttribute(place('stop'), 'aria-pressed', String(stopped));
  updateAttribute(document.body, 'data-control', model.controls !== null);
  updateText(place('node'), model.node.replace(/^\//, '') || 'serial_communication');
  const sign = !alive ? '✕ no connection' : words ? `${words === STOPPED ? '■' : '✕'} ${words}` : state.words ? `${state.sign} ${state.words}` : '✓';
  const title = `${sign} · ${place('node').textContent}`;
  if (document.title !== title) document.title = title;
}

let requested = false;
let drawnAt = 0;

function draw() {
  requested = false;
  drawnAt = performance.now();
  const now = connection.now();
  drawHead(now);
  for (const each of cards) {
    try {
      each.draw(model, now);
    } catch (error) {       // draw the other cards nevertheless
      console.error(error);
    }
  }
}

function drawSoon() {
  if (requested) return;
  requested = true;
  requestAnimationFrame(draw);
}

connection.addEventListener('update', ({detail: update}) => {
  if ('node' in update) appear();       // the first update of a connection: now there are controls
  model.take(update);
  if (update.known && topicCards.learn(update.known)) {
    watch();
    markCards();
    arrange();
  }
  if (update.wire) wire.take(update.wire);
  if (update.refused) {
    if (update.refused.key === 'drive') drive.refused(update.refused.words);
    else commands.refused(update.refused);
  }
  drawSoon();
});
setInterval(() => { if (performance.now() - drawnAt > IDLE) drawSoon(); }, IDLE);
showTab('Links');
watch();
