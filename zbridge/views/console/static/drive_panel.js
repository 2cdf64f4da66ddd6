// The panel by which a person takes control of a robot and drives it.

import { html, useEffect, useRef, useState } from "./vendor/htm-preact.js";
import { leave } from "./header.js";

const MODES = ["none", "manual", "autonomous"];
const PROFILES = { sideways: "Sideways", inverted: "Inverted", hold: "Hold a shoulder button to drive" };
const MOTORS = { rotational: "rad/s", linear: "m" };

export function DrivePanel({ drive, row, data }) {
  const [, turn] = useState(0);
  useEffect(() => {
    drive.changed = () => turn((count) => count + 1);
    return () => (drive.changed = () => {});
  }, [drive]);
  const drivable = row.commands.includes("drive") || row.commands.includes("motor");
  const { state, notice } = drive.control;
  if (!drive.store.may("drive") || (!drivable && state === "none")) return null; // while it is driven the panel stays, whatever its gateway says
  return html`<section class="panel drive" aria-label="Drive">
    <${Control} drive=${drive} row=${row} />
    ${notice && html`<p class="age" role="status">${notice}</p>`}
    ${state === "held" && html`<${Steering} drive=${drive} row=${row} data=${data} />`}
  </section>`;
}

// Who has control, and the buttons to take it and to give it back.
function Control({ drive, row }) {
  const [asked, ask] = useState(false);
  const other = row.driver && !["stopped", "LATCHED"].includes(row.driver) ? row.driver : "";
  const { state } = drive.control;
  useEffect(() => ask(false), [state, other]);
  const press = (action) => (event) => {
    leave(event);
    action();
  };
  if (state === "held") {
    return html`<div class="bar tight"><b>You drive ${row.name}</b>
      <button type="button" onClick=${press(() => drive.give())}>Give back</button></div>`;
  }
  if (state === "asking") return html`<p>Asking the gateway of ${row.name} for control.</p>`;
  if (asked && !drive.store.may("take_over")) {
    return html`<p class="question">${other} drives ${row.name}. Taking over needs the role supervisor.
      <button type="button" onClick=${press(() => ask(false))}>Close</button></p>`;
  }
  if (asked) {
    return html`<p class="question">${other} drives ${row.name}, and loses control.
      <button type="button" class="sure" onClick=${press(() => drive.take(true))}>Take over</button>
      <button type="button" onClick=${press(() => ask(false))}>Cancel</button></p>`;
  }
  return html`<div class="bar tight"><button type="button" onClick=${press(() => (other ? ask(true) : drive.take()))}>
    Take control</button> <span class="empty">${other ? `${other} drives` : "nobody drives"}</span></div>`;
}

function Steering({ drive, row, data }) {
  const { needs } = drive.control;
  const [, turn] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => turn((count) => count + 1), 100); // what the page waits for changes without events
    return () => clearInterval(timer);
  }, []);
  const why = { focus: "this page does not have the focus", link: "the connection is too slow or stalled" }[drive.wasBlocked];
  const waits = why ? `Not driving: ${why}.` : needs ? `Release all keys and centre the stick: ${needs}.` : "";
  const trip = drive.roundTrip === null ? "" : `round trip ${Math.round(1000 * drive.roundTrip)} ms`;
  return html`<div class="steering">
    <p class="waits ${waits ? "age" : ""}" role="status">${waits || (drive.moving ? "Driving." : "Ready.")}</p>
    ${row.commands.includes("drive") && html`<${Stick} drive=${drive} />`}
    <div class="settings">
      <label>Speed limit ${Math.round(100 * drive.limit)} %
        <input type="range" min="5" max="100" step="5" value=${Math.round(100 * drive.limit)}
          onInput=${(event) => drive.setLimit(event.target.value / 100)} onChange=${leave} />
      </label>
      <p class="empty">W A S D or arrows drive, Q E move sideways, Space stops. ${trip}</p>
      <${Gamepad} drive=${drive} />
      ${row.commands.includes("mode") && html`<${Mode} drive=${drive} />`}
      ${row.commands.includes("motor") && html`<${Motors} drive=${drive} data=${data} />`}
    </div>
  </div>`;
}

function Stick({ drive }) {
  const pad = useRef(null);
  const stick = drive.inputs.stick;
  const [, turn] = useState(0);
  const on = (method) => (event) => {
    if (method === "down") pad.current.setPointerCapture(event.pointerId);
    stick[method](event, pad.current.getBoundingClientRect());
    drive.send();
    turn((count) => count + 1);
  };
  const { x, y } = stick.at;
  return html`<div class="stick" ref=${pad} role="img" aria-label="Stick: drag to drive"
    onPointerDown=${on("down")} onPointerMove=${on("move")} onPointerUp=${on("up")} onPointerCancel=${on("up")}>
    <span class="knob" style=${{ transform: `translate(${50 * x}px, ${-50 * y}px)` }}></span>
  </div>`;
}

function Gamepad({ drive }) {
  const { pad, isStuck, profile, needsHold } = drive.inputs.pads;
  if (!pad) return html`<p class="empty">No gamepad: press a button of one.</p>`;
  const set = (name) => (event) => {
    leave(event);
    drive.inputs.pads.set(name, !profile[name]);
  };
  const state = isStuck ? "sends nothing new: it counts as centred" : needsHold ? "hold a shoulder button" : "drives";
  return html`<div class="switch" role="group" aria-label="Gamepad">
    <span>${pad.id.slice(0, 40)}: ${state}</span>
    ${Object.entries(PROFILES).map(
      ([name, title]) => html`<button type="button" aria-pressed=${profile[name]} onClick=${set(name)}>${title}</button>`,
    )}
  </div>`;
}

function Mode({ drive }) {
  const set = (mode) => (event) => {
    leave(event);
    drive.setMode(mode);
  };
  return html`<div class="switch" role="group" aria-label="Mode"><span>mode</span>
    ${MODES.map((mode) => html`<button type="button" aria-pressed=${drive.control.mode === mode} onClick=${set(mode)}>${mode}</button>`)}
  </div>`;
}

// Single motors move while their buttons are held.
function Motors({ drive, data }) {
  const [speed, setSpeed] = useState(1);
  const motors = (data.message("devices")?.devices ?? []).filter((device) => device.kind in MOTORS).slice(0, 16);
  const command = (motor) => {
    drive.inputs.motor = motor;
    drive.send();
  };
  const hold = ({ name, kind }, value) => ({
    onPointerDown: (event) => {
      event.currentTarget.setPointerCapture(event.pointerId);
      command({ name, value, linear: kind === "linear" });
    },
    onPointerUp: () => command(null),
    onPointerCancel: () => command(null),
  });
  if (!motors.length) return null;
  return html`<div class="motors" role="group" aria-label="Motors">
    <label>Motors: <input type="number" min="0" max="1000" step="any" value=${speed} aria-label="Motor value"
      onInput=${(event) => Number.isFinite(event.target.valueAsNumber) && setSpeed(event.target.valueAsNumber)} /></label>
    ${motors.map(
      (motor) => html`<div class="switch"><span>${motor.name}</span>
        <button type="button" aria-label=${`${motor.name} backwards`} ...${hold(motor, -speed)}>−</button>
        <button type="button" aria-label=${`${motor.name} forwards`} ...${hold(motor, speed)}>+</button>
        <span class="empty">${MOTORS[motor.kind]}</span></div>`,
    )}
  </div>`;
}
