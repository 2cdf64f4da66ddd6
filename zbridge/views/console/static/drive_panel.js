// The panel by which a person takes control of a robot and drives it.

import { html, useEffect, useRef, useState } from "./vendor/htm-preact.js";
import { driverOf, leave } from "./words.js";

const MODES = ["none", "manual", "autonomous"];
const PROFILES = { sideways: "Sideways", inverted: "Inverted", hold: "Hold a shoulder button to drive" };
const MOTORS = { rotational: "rad/s", linear: "m" };
const WAYS = [["forward", "forward", "backward"], ["left", "left", "right"], ["turn", "turn left", "turn right"]];

export function DrivePanel({ drive, row, data }) {
  const [, turn] = useState(0);
  useEffect(() => {
    drive.changed = () => turn((count) => count + 1);
    return () => (drive.changed = () => {});
  }, [drive]);
  const drivable = row.commands.includes("drive") || row.commands.includes("motor");
  const { state, notice } = drive.control;
  if (!drive.store.may("drive") || (!drivable && state === "none")) return null; // while it is driven the panel stays, whatever its gateway says
  return html`<section class="panel drive ${state}" aria-label="Drive">
    ${state === "held" ? html`<${Driving} drive=${drive} row=${row} data=${data} />` : html`<${Control} drive=${drive} row=${row} />`}
    ${notice && html`<p class="age" role="status">${notice}</p>`}
  </section>`;
}

// Who has control, and the button to take it.
function Control({ drive, row }) {
  const [asked, ask] = useState(false);
  const other = driverOf(row);
  const { state } = drive.control;
  useEffect(() => ask(false), [state, other]);
  const press = (action) => (event) => {
    leave(event);
    action();
  };
  if (state === "asking") return html`<p>Asking the gateway of ${row.name} for control.</p>`;
  if (asked && !drive.store.may("take_over")) {
    return html`<p class="question">${other} is driving ${row.name} now. Taking over needs the role supervisor.
      <button type="button" onClick=${press(() => ask(false))}>Close</button></p>`;
  }
  if (asked) {
    return html`<p class="question">${other} is driving now, and loses control at once; ${row.name} stops first. Take over?
      <button type="button" class="careful" onClick=${press(() => drive.take(true))}>Take over</button>
      <button type="button" onClick=${press(() => ask(false))}>Keep watching</button></p>`;
  }
  const why = whyNot(row);
  return html`<div class="control"><button type="button" disabled=${Boolean(why)} onClick=${press(() => (other ? ask(true) : drive.take()))}>
    Take control</button> <span class="empty">${why || (other ? `${other} drives` : "nobody drives")}</span></div>`;
}

// Why nobody can take control now; "" if somebody can.
function whyNot(row) {
  if (row.latched.length) return `${row.name} is latched: it must be released first.`;
  return row.state === "stalled" ? "The robot does not acknowledge commands." : "";
}

function Driving({ drive, row, data }) {
  const { needs } = drive.control;
  const [, turn] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => turn((count) => count + 1), 100); // what the page waits for changes without events
    return () => clearInterval(timer);
  }, []);
  const act = (action) => (event) => {
    leave(event);
    action();
  };
  const why = { focus: "this page does not have the focus", link: "the connection is too slow or stalled" }[drive.wasBlocked];
  const waits = why ? `Not driving: ${why}.` : needs ? `Release all keys and centre the stick: ${needs}.` : "";
  return html`<div class="control"><b>You drive ${row.name}</b>
      <button type="button" onClick=${act(() => drive.give())}>Give back</button></div>
    <p class="waits ${waits ? "age" : ""}"><span role="status">${waits || (drive.moving ? "Driving." : "Ready.")}</span> 
      <span>${!waits && commanded(drive.sent)}</span>
      <span class="trip empty">${drive.roundTrip !== null && `round trip ${Math.round(1000 * drive.roundTrip)} ms`}</span></p>
    <div class="steering">
      ${row.commands.includes("drive") && html`<${Stick} drive=${drive} />`}
      <div class="settings">
        <button type="button" class="stop" onClick=${act(() => drive.stop())}>Stop ${row.name}</button>
        <label>Speed limit ${Math.round(100 * drive.limit)} %
          <input type="range" min="5" max="100" step="5" value=${Math.round(100 * drive.limit)}
            onInput=${(event) => drive.setLimit(event.target.value / 100)} onChange=${leave} />
        </label>
        <p class="empty keys">W A S D or arrows drive, Q E move sideways where the robot can, Space stops.</p>
      </div>
    </div>
    <${Gamepad} drive=${drive} />
    ${row.commands.includes("mode") && html`<${Mode} drive=${drive} robot=${row.name} />`}
    ${row.commands.includes("motor") && html`<${Motors} drive=${drive} data=${data} />`}`;
}

// What the robot is told now, in words.
function commanded({ motor, ...sent }) {
  if (motor) return `${motor.name} ${motor.value}`;
  const parts = WAYS.filter(([axis]) => sent[axis]).map(
    ([axis, more, less]) => `${sent[axis] > 0 ? more : less} ${Math.round(Math.abs(100 * sent[axis]))} %`,
  );
  return parts.join(", ") || "Standing: the stick is centred.";
}

function Stick({ drive }) {
  const pad = useRef(null);
  const stick = drive.inputs.stick;
  const [, turn] = useState(0);
  const on = (method) => (event) => {
    if (method === "down") pad.current.setPointerCapture(event.pointerId);
    stick[method](event, pad.current.getBoundingClientRect());
    if (event.pointerId !== stick.pointer) return;
    drive.sendSoon();
    turn((count) => count + 1);
  };
  useEffect(() => () => stick.clear(), []);
  const { forward, turn: turns } = drive.sent;
  const { x, y } = stick.pointer === null ? { x: -turns / drive.limit, y: forward / drive.limit } : stick.at; // keys move the knob, too
  return html`<div class="stick" ref=${pad} role="img" aria-label="Stick: drag to drive"
    onPointerDown=${on("down")} onPointerMove=${on("move")}>
    <span class="knob" style=${{ transform: `translate(${42 * x}px, ${-42 * y}px)` }}></span>
  </div>`;
}

function Gamepad({ drive }) {
  const { pad, isStuck, profile, needsHold } = drive.inputs.pads;
  if (!pad) return html`<p class="empty keys">No gamepad. If one is connected, press one of its buttons.</p>`;
  const set = (name) => (event) => {
    leave(event);
    drive.inputs.pads.set(name, !profile[name]);
  };
  const state = isStuck ? "sends nothing new: it counts as centred" : needsHold ? "hold a shoulder button" : "drives";
  return html`<h3>Gamepad</h3><div class="switch" role="group" aria-label="Gamepad">
    <span>${pad.id.slice(0, 40)}: ${state}</span>
    ${Object.entries(PROFILES).map(
      ([name, title]) => html`<button type="button" aria-pressed=${profile[name]} onClick=${set(name)}>${title}</button>`,
    )}
  </div>`;
}

function Mode({ drive, robot }) {
  const [asked, ask] = useState(false);
  const { mode } = drive.control;
  const choose = (wanted) => (event) => {
    leave(event);
    ask(wanted === "autonomous");
    if (wanted !== "autonomous") drive.setMode(wanted);
  };
  const answer = (yes) => () => {
    ask(false);
    if (yes) drive.setMode("autonomous");
  };
  return html`<h3>Mode</h3>
    <div class="switch" role="group" aria-label="Mode">
      ${MODES.map((each) => html`<button type="button" aria-pressed=${mode === each} onClick=${choose(each)}>${each}</button>`)}
    </div>
    ${asked && html`<p class="question">${robot} then moves by itself.
      <button type="button" class="careful" onClick=${answer(true)}>Set autonomous</button>
      <button type="button" onClick=${answer(false)}>Cancel</button></p>`}`;
}

// Single motors move while their buttons are held.
function Motors({ drive, data }) {
  const [speed, setSpeed] = useState(1);
  const motors = (data.message("devices")?.devices ?? []).filter((device) => device.kind in MOTORS).slice(0, 16);
  const hold = ({ name, kind }, value) => (event) => {
    event.currentTarget.setPointerCapture(event.pointerId);
    drive.inputs.hold(event, { name, value, linear: kind === "linear" });
    drive.send();
  };
  useEffect(() => () => drive.inputs.clear(), []);
  if (!motors.length) return null;
  return html`<details class="motors" role="group" aria-label="Motors"><summary onClick=${leave}>Single motors</summary>
    <label>Value, while a button is held <input type="number" min="0" max="1000" step="any" value=${speed} aria-label="Motor value"
      onInput=${(event) => Number.isFinite(event.target.valueAsNumber) && setSpeed(event.target.valueAsNumber)} /></label>
    <div class="grid">${motors.map(
      (motor) => html`<span>${motor.name}</span>
        <button type="button" aria-label=${`${motor.name} backwards`} onPointerDown=${hold(motor, -speed)}>−</button>
        <button type="button" aria-label=${`${motor.name} forwards`} onPointerDown=${hold(motor, speed)}>+</button>
        <span class="empty">${MOTORS[motor.kind]}</span>`,
    )}</div>
  </details>`;
}
