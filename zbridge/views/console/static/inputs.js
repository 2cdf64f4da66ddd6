// What a person steers with: keys, the stick on the page, a gamepad. Each gives forward, left and turn, -1 to 1.

const KEYS = {
  KeyW: { forward: 1 }, ArrowUp: { forward: 1 },
  KeyS: { forward: -1 }, ArrowDown: { forward: -1 },
  KeyA: { turn: 1 }, ArrowLeft: { turn: 1 },
  KeyD: { turn: -1 }, ArrowRight: { turn: -1 },
  KeyQ: { left: 1 },
  KeyE: { left: -1 },
};
const DEAD_ZONE = 0.12; // part of an axis that counts as centred
const DEAD_PAD_S = 2; // a pad whose timestamp stays the same for so long is taken for dead
const HOLD_BUTTONS = [4, 5, 6, 7]; // the shoulder buttons: one of them is held to drive
const PROFILE = "zbridge.gamepad";

const clamp = (value) => Math.min(1, Math.max(-1, value));
export const NEUTRAL = Object.freeze({ forward: 0, left: 0, turn: 0 });
export const isNeutral = ({ forward, left, turn }) => !forward && !left && !turn;

// The keys that are held. A key counts from a press that the page received while it had the focus.
class Keyboard {
  constructor() {
    this.held = new Set();
  }

  // Returns whether the key steers.
  press(event) {
    if (!(event.code in KEYS) || event.ctrlKey || event.altKey || event.metaKey) return false;
    if (!event.repeat && document.hasFocus()) this.held.add(event.code);
    return true;
  }

  release(event) {
    return this.held.delete(event.code);
  }

  clear() {
    this.held.clear();
  }

  read() {
    const sum = { ...NEUTRAL };
    for (const code of this.held) for (const [axis, value] of Object.entries(KEYS[code])) sum[axis] += value;
    return { forward: clamp(sum.forward), left: clamp(sum.left), turn: clamp(sum.turn) };
  }
}

// The stick on the page: a knob that one pointer drags.
class PageStick {
  constructor() {
    this.pointer = null;
    this.at = { x: 0, y: 0 }; // right and up, -1 to 1
  }

  down(event, box) {
    if (this.pointer !== null) return;
    this.pointer = event.pointerId;
    this.move(event, box);
  }

  move(event, box) {
    if (event.pointerId !== this.pointer) return;
    const radius = box.width / 2;
    const [x, y] = [(event.clientX - box.left - radius) / radius, (box.top + radius - event.clientY) / radius];
    const far = Math.max(1, Math.hypot(x, y));
    this.at = { x: x / far, y: y / far };
  }

  clear() {
    this.pointer = null;
    this.at = { x: 0, y: 0 };
  }

  read() {
    return { forward: zoned(this.at.y), left: 0, turn: zoned(-this.at.x) };
  }
}

// The gamepad that was moved last. changes: rises when pads come or go, or a dead one is alive again.
class Gamepads {
  constructor() {
    this.changes = 0;
    this.known = "";
    this.seen = new Map(); // by name: the timestamp, since when it is the same, and whether the pad was deflected then
    this.pad = null;
    this.profile = { sideways: false, inverted: false, hold: false, ...readProfile() };
  }

  set(name, on) {
    this.profile = { ...this.profile, [name]: on };
    this.changes += 1; // the same deflection means another motion from now on
    localStorage.setItem(PROFILE, JSON.stringify(this.profile));
  }

  poll() {
    const pads = [...(navigator.getGamepads?.() ?? [])].filter((pad) => pad?.connected);
    const names = pads.map(nameOf);
    if (names.join("\n") !== this.known) this.changes += 1;
    this.known = names.join("\n");
    for (const name of this.seen.keys()) if (!names.includes(name)) this.seen.delete(name);
    pads.forEach((pad) => this.note(pad));
    this.choose(pads);
  }

  // Keeps the pad, until another one alone is deflected.
  choose(pads) {
    const before = this.pad && nameOf(this.pad);
    const current = pads.find((pad) => nameOf(pad) === before);
    const steering = pads.filter((pad) => deflected(pad) && !this.isDead(pad));
    this.pad = steering.includes(current) ? current : steering[0] ?? current ?? pads[0] ?? null;
    if (before && this.pad && nameOf(this.pad) !== before) this.changes += 1;
  }

  // A pad that froze while it was deflected, and sends again, must be centred first.
  note(pad) {
    const seen = this.seen.get(nameOf(pad));
    if (seen?.timestamp === pad.timestamp) return;
    if (seen?.deflected && this.isDead(pad)) this.changes += 1;
    this.seen.set(nameOf(pad), { timestamp: pad.timestamp, since: performance.now() / 1000, deflected: deflected(pad) });
  }

  isDead(pad) {
    const seen = this.seen.get(nameOf(pad));
    return seen !== undefined && performance.now() / 1000 - seen.since >= DEAD_PAD_S;
  }

  // Whether the pad is deflected, and counts as centred because it sends nothing new.
  get isStuck() {
    return this.pad !== null && deflected(this.pad) && this.isDead(this.pad);
  }

  // Whether the pad would move the robot, if one of its buttons were held.
  get needsHold() {
    return this.profile.hold && this.pad !== null && !HOLD_BUTTONS.some((button) => this.pad.buttons[button]?.pressed);
  }

  read() {
    if (!this.pad || this.isDead(this.pad) || this.needsHold) return NEUTRAL;
    const [across, along, second = 0] = this.pad.axes.map(zoned);
    const forward = this.profile.inverted ? along : -along; // pads count down as positive
    return this.profile.sideways ? { forward, left: -across, turn: -second } : { forward, left: 0, turn: -across };
  }
}

function readProfile() {
  try {
    const { sideways, inverted, hold } = JSON.parse(localStorage.getItem(PROFILE)) ?? {};
    return { sideways: sideways === true, inverted: inverted === true, hold: hold === true };
  } catch {
    return {};
  }
}

const nameOf = (pad) => `${pad.index} ${pad.id}`;
const deflected = (pad) => pad.axes.some((value) => zoned(value));

// An axis without its dead zone: it begins at 0 at the zone's end.
function zoned(value) {
  if (!Number.isFinite(value)) return 0;
  const beyond = Math.max(0, Math.abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE);
  return Math.sign(value) * Math.min(1, beyond);
}

// All inputs together: the one that is deflected; a key wins over the stick on the page, and this over a gamepad.
export class Inputs {
  constructor() {
    this.keyboard = new Keyboard();
    this.stick = new PageStick();
    this.pads = new Gamepads();
    this.motor = null; // name and value of a single motor while its button is held
    this.motorPointer = null;
  }

  hold(event, motor) {
    this.motor = motor;
    this.motorPointer = event.pointerId;
  }

  // Lets go what a pointer held, wherever it is released. Returns whether it held anything.
  release(event) {
    const [holds, turns] = [event.pointerId === this.stick.pointer, event.pointerId === this.motorPointer];
    if (holds) this.stick.clear();
    if (turns) this.motor = this.motorPointer = null;
    return holds || turns;
  }

  clear() {
    this.keyboard.clear();
    this.stick.clear();
    this.motor = this.motorPointer = null;
  }

  read() {
    return [this.keyboard, this.stick, this.pads].map((input) => input.read()).find((value) => !isNeutral(value)) ?? NEUTRAL;
  }
}
