// Drives one robot: the drive socket, its ticks, and what makes the page send neutral.
//
// The server decides whether the robot moves (drive_link.py, seats.py). The page sends its command 20 times a second and
// at each change, names the newest tick with it, and sends neutral whenever it cannot know that somebody steers.

import { Inputs, NEUTRAL, isNeutral } from "./inputs.js";

const REPEAT_MS = 50;
const NO_TICK_S = 0.3;
const SLOW_S = 0.2; // round trips above this are too slow to drive
const RESUME_S = 3; // how long the server keeps control for a page
const AGAIN_MS = 250;
const WAITS_S = 2; // how long what a person asked for waits for the connection
const LIMIT = "zbridge.limit";
const NONE = { state: "none", needs: null, notice: null, mode: "none" };

export class Drive {
  constructor(robot, store) {
    this.robot = robot;
    this.store = store;
    this.inputs = new Inputs();
    this.control = NONE;
    this.limit = Number(localStorage.getItem(LIMIT)) || 0.5;
    this.socket = null;
    this.seq = 0;
    this.tick = { number: 0, at: -Infinity };
    this.sentAt = new Map(); // when recent commands were sent, by number
    this.roundTrip = null; // seconds
    this.epoch = 0;
    this.why = "";
    this.wasBlocked = null;
    this.padChanges = 0;
    this.moving = false;
    this.soon = null;
    this.sent = { ...NEUTRAL, motor: null }; // what the robot is told
    this.lostAt = null;
    this.changed = () => {};
    this.wakeLock = null;
    this.stopListening = this.listen();
    this.timer = setInterval(() => this.send(), REPEAT_MS);
    if (this.token) this.connect();
  }

  // Ends with the page of the robot: control is given back.
  close() {
    clearInterval(this.timer);
    this.stopListening();
    this.give();
    this.token = null;
    this.socket?.close();
    this.socket = null;
    this.wakeLock?.release();
  }

  get held() {
    return this.control.state === "held";
  }

  // By which a reloaded page gets its control back. Each page takes it out: a copy of this tab finds none later.
  get token() {
    return sessionStorage.getItem(`zbridge.control.${this.robot}`);
  }

  set token(token) {
    const name = `zbridge.control.${this.robot}`;
    if (token) sessionStorage.setItem(name, token);
    else sessionStorage.removeItem(name);
  }

  // What the person does

  take(takeover = false) {
    this.inputs.clear();
    this.connect();
    this.say({ do: "take", takeover });
  }

  give() {
    this.say({ do: "give" });
    this.token = null;
  }

  setMode(mode) {
    this.say({ do: "mode", mode });
  }

  setLimit(limit) {
    this.limit = limit;
    localStorage.setItem(LIMIT, String(limit));
    this.send();
  }

  stop() {
    this.inputs.clear();
    this.send();
    this.store.stop(this.robot);
  }

  listen() {
    const steers = (event) => this.held && !event.target.closest?.("input");
    const on = {
      keydown: (event) => {
        if (event.key === "Meta") this.leave(); // its system keeps the releases of other keys to itself
        if (event.code === "Space" && this.held) event.repeat || this.stop();
        else if (!steers(event)) return;
        else if (!this.inputs.keyboard.press(event)) return;
        event.preventDefault();
        this.send();
      },
      keyup: (event) => this.inputs.keyboard.release(event) && this.send(),
      contextmenu: (event) => (event.target.closest?.(".steering, .motors") ? event.preventDefault() : this.leave()),
      dragstart: () => this.leave(),
      pointerup: (event) => this.inputs.release(event) && this.send(),
      pointercancel: (event) => this.inputs.release(event) && this.send(),
      blur: (event) => event.target === window && this.leave(),
      pagehide: () => this.leave(),
      freeze: () => this.leave(),
      visibilitychange: () => document.hidden && this.leave(),
    };
    for (const [type, listener] of Object.entries(on)) addEventListener(type, listener, true);
    return () => Object.entries(on).forEach(([type, listener]) => removeEventListener(type, listener, true));
  }

  // Nobody is known to steer any more: what was held counts no longer.
  leave() {
    this.inputs.clear();
    this.send();
  }

  // The socket

  connect() {
    if (this.socket) return;
    const socket = (this.socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/drive/${this.robot}`));
    this.tick = { number: 0, at: -Infinity };
    this.sentAt.clear();
    this.waiting = [];
    const token = this.token;
    this.token = null;
    if (token) this.say({ do: "resume", token });
    socket.onopen = () => {
      const fresh = this.waiting.splice(0).filter(({ at }) => performance.now() / 1000 - at < WAITS_S);
      for (const { message } of fresh) this.say(message);
    };
    socket.onmessage = (event) => this.socket === socket && this.receive(JSON.parse(event.data));
    socket.onclose = () => this.socket === socket && this.lose(token);
  }

  say(message) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
    else if (message.do !== "drive") this.waiting?.push({ message, at: performance.now() / 1000 });
  }

  receive(message) {
    if ("tick" in message) this.tick = { number: message.tick, at: performance.now() / 1000 };
    if ("ack" in message && this.sentAt.has(message.ack)) {
      this.roundTrip = performance.now() / 1000 - this.sentAt.get(message.ack) - message.held_ms / 1000;
    }
    if ("control" in message) this.receiveControl(message.control);
  }

  receiveControl(control) {
    const began = !this.held && control.state === "held";
    this.control = control;
    this.token = control.token;
    this.lostAt = null;
    if (began) this.keepAwake();
    if (!this.held) {
      this.inputs.clear(); // a button that is held may vanish with control, and its release with it
      this.wakeLock?.release();
    }
    this.send();
    this.changed();
  }

  // The socket has ended: control is resumed with the token, if the console is back in time.
  lose(token) {
    const mayResume = this.token ?? token;
    this.lostAt ??= performance.now() / 1000;
    this.socket = null;
    this.control = { ...NONE, notice: "The connection to the console was lost: the robot is stopped." };
    this.roundTrip = null;
    this.wakeLock?.release();
    this.changed();
    if (!mayResume || performance.now() / 1000 - this.lostAt > RESUME_S) return;
    this.token = mayResume;
    setTimeout(() => this.token && this.connect(), AGAIN_MS);
  }

  async keepAwake() {
    try {
      this.wakeLock = await navigator.wakeLock?.request("screen");
    } catch {
      this.wakeLock = null; // the browser may refuse it, with a low battery for example
    }
  }

  // What is sent

  // Why the page may not move the robot now; null if it may. The server judges for itself.
  get blocked() {
    const silent = performance.now() / 1000 - this.tick.at > NO_TICK_S;
    if (document.hidden || !document.hasFocus()) return "focus";
    return silent || (this.roundTrip ?? 0) > SLOW_S ? "link" : null;
  }

  // Sends what the stick shows with the next picture: a pointer may move more often.
  sendSoon() {
    this.soon ??= requestAnimationFrame(() => {
      this.soon = null;
      this.send();
    });
  }

  send() {
    this.inputs.pads.poll();
    if (this.control.state === "none" || this.socket?.readyState !== WebSocket.OPEN || !this.tick.number) return;
    this.noteChanges();
    const blocked = this.wasBlocked;
    const { forward, left, turn } = blocked ? NEUTRAL : this.inputs.read();
    const motor = blocked ? null : this.inputs.motor;
    const command = { forward: forward * this.limit, left: left * this.limit, turn: turn * this.limit, motor };
    this.seq += 1;
    this.sentAt.set(this.seq, performance.now() / 1000);
    if (this.sentAt.size > 100) this.sentAt.delete(this.sentAt.keys().next().value);
    const { epoch, why, seq } = this;
    this.say({ do: "drive", seq, tick: this.tick.number, epoch, why, ...command });
    this.sent = command;
    this.moving = !isNeutral(command) || Boolean(motor?.value);
  }

  // A new epoch makes the server wait for neutral: after regained focus, a slow connection, other gamepads.
  noteChanges() {
    const blocked = this.blocked;
    if (blocked !== this.wasBlocked) this.begin(this.wasBlocked || blocked); // it also ends the mode autonomous
    this.wasBlocked = blocked;
    if (this.inputs.pads.changes !== this.padChanges) {
      this.padChanges = this.inputs.pads.changes;
      this.begin("gamepad");
    }
  }

  begin(why) {
    this.epoch += 1;
    this.why = why;
  }
}
