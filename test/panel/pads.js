// Runs each list of steps on a pad of its own, with a clock of its own. Gives the words that it shows half
// a second later, and whether it drives after the steps and still then.
const [lists, done] = arguments;
let now = performance.now(), tick = null;
const pass = (ms) => { for (; ms > 0; ms -= 50) { now += 50; tick?.(); } };
const run = (Drive, steps) => {
  const sent = [], connection = Object.assign(new EventTarget(), {seen: 0, silence: () => 0,
    send: (message) => sent.push(...Object.keys(message))});
  const drive = new Drive(connection, () => {});
  const pad = drive.element.querySelector('.pad');
  pad.setPointerCapture = () => {};
  pad.getBoundingClientRect = () => ({left: 0, top: 0, width: 2, height: 2});
  const act = {
    wait: (ms) => pass(Number(ms)),
    pointer: (what, pointerId = 1, clientX = 1) => {
      pad.dispatchEvent(new PointerEvent(`pointer${what}`, {button: 0, pointerId, clientX, clientY: 0}));
    },
    key: (what, key) => {
      const [code, modifier] = key.split('+').reverse();
      pad.dispatchEvent(new KeyboardEvent(what === 'up' ? 'keyup' : 'keydown',
        {code, repeat: what === 'repeat', [`${modifier}Key`]: true}));
    }};
  pass(2000);
  for (const [kind, ...more] of steps.split(', ').map((each) => each.split(' '))) {
    act[kind](...more);
  }
  const drives = sent.splice(0).at(-1) === 'drive';
  pass(500);
  const stillDrives = sent.length > 0;
  const words = drive.element.querySelector('#pad-words').textContent;
  drive.refused('');
  return [words, drives, stillDrives];
};
// The page's own clock stands meanwhile: all steps are done at once.
import('/cards/drive.js').then(({Drive}) => {
  const {setInterval, clearInterval} = window;
  performance.now = () => now;
  window.setInterval = (call) => { tick = call; return 1; };
  window.clearInterval = () => { tick = null; };
  try {
    return lists.map((steps) => run(Drive, steps));
  } finally {
    delete performance.now;
    Object.assign(window, {setInterval, clearInterval});
  }
}).then(done, (error) => done(String(error)));
