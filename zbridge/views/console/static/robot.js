// The page of one robot: its picture, its plots, what is known of it, and its stop.

import { html, useEffect, useRef, useState } from "./vendor/htm-preact.js";
import { Drive } from "./drive.js";
import { DrivePanel } from "./drive_panel.js";
import { Plots, readValues } from "./plots.js";
import { Facts, History, Published, Refusals, Sensors, Sessions, Switches, Texts } from "./panels.js";
import { Scene } from "./scene.js";
import { doubtOf, driverOf, leave, span, toneOf, whyOf, wordOf } from "./words.js";

const TICK_MS = 250;
const WAIT_S = 3; // until what has not come is taken for not published
const PRESENT = ["established", "LATCHED", "stalled"];

export function Robot({ store, name }) {
  const row = store.rows.get(name);
  const [, turn] = useState(0);
  const data = useRobot(store, name, () => turn((count) => count + 1));
  const drive = useDrive(store, name);
  if (!row) {
    return html`<section class="robot">
      <h1>${name}</h1>
      <p>${store.known ? "The console does not know this robot." : "Loading."} <a href="#">All robots</a></p>
    </section>`;
  }
  data.away = !PRESENT.includes(row.state) || !store.connected || store.silent || !store.bus;
  return html`<section class="robot">
    <${Title} row=${row} store=${store} data=${data} own=${drive?.held} />
    ${doubtOf(row) && html`<p class="band" role="alert">${doubtOf(row)} Stop may not reach it. Use the emergency stop on the robot.</p>`}
    <div class="columns">
      <div class="views">
        <${Picture} data=${data} />
        <${Camera} data=${data} />
        <${Plots} data=${data} />
      </div>
      <div class="panels">
        ${drive && html`<${DrivePanel} drive=${drive} row=${row} data=${data} />`}
        <${Facts} row=${row} data=${data} />
        <${Switches} row=${row} data=${data} store=${store} />
        <${Published} data=${data} waited=${performance.now() / 1000 - data.began > WAIT_S} />
        <${Refusals} data=${data} />
        <${History} data=${data} />
        <${Sensors} data=${data} />
        <${Sessions} data=${data} />
        <${Texts} data=${data} />
      </div>
    </div>
  </section>`;
}

// Looks at a robot while its page is in sight, and redraws the text of the page four times a second.
function useRobot(store, name, redraw) {
  const data = useRef(null);
  if (data.current?.name !== name) data.current = store.data(name);
  useEffect(() => {
    const see = () => store.look(document.hidden ? "" : name);
    const tick = setInterval(() => {
      if (document.hidden) return;
      data.current.sample(readValues(data.current));
      redraw();
    }, TICK_MS);
    see();
    document.addEventListener("visibilitychange", see);
    return () => {
      clearInterval(tick);
      document.removeEventListener("visibilitychange", see);
      store.look("");
    };
  }, [name]);
  return data.current;
}

// Drives the robot of this page, while the page shows it.
function useDrive(store, name) {
  const [drive, setDrive] = useState(null);
  useEffect(() => {
    const made = new Drive(name, store);
    setDrive(made);
    return () => made.close();
  }, [name]);
  return drive?.robot === name ? drive : null;
}

// own: whether this page drives it.
function Title({ row, store, data, own }) {
  const latchedAlone = (data.message("control")?.latches ?? []).some((latch) => !latch.fleet);
  const act = (action) => (event) => {
    leave(event);
    action();
  };
  return html`<div class="title ${toneOf(row)}">
    <a class="back" href="#" aria-label="All robots">‹ All robots</a>
    <h1>${row.name}</h1>
    <span class="state"><b>${wordOf(row)}</b></span>
    <span class="driver">${own ? "you drive" : driverText(row)}</span>
    <span class="acts">
      ${latchedAlone && store.may("unlatch") && html`<button type="button" class="careful" onClick=${act(() => store.ask({ do: "unlatch", robot: row.name }))}>Release ${row.name}</button>`}
      <button type="button" class="stop" aria-label=${`Stop ${row.name}`} onClick=${act(() => store.stop(row.name))}>Stop</button>
    </span>
    <p class="why" tabindex=${whyOf(row) ? 0 : -1}>${whyOf(row)}</p>
  </div>`;
}

function driverText(row) {
  const driver = driverOf(row);
  if (driver === null) return "driver not known";
  return driver ? `${driver} drives` : "nobody drives";
}

function Picture({ data }) {
  const canvas = useRef(null);
  const scene = useRef(null);
  const [, turn] = useState(0);
  useEffect(() => {
    const made = (scene.current = new Scene(canvas.current, data));
    made.moved = () => turn((count) => count + 1);
    data.changed = () => made.schedule();
    return () => {
      data.changed = () => {};
      made.close();
    };
  }, [data]);
  useEffect(() => scene.current.schedule()); // ages, too
  const old = ["map", "scan", "pose"].filter((path) => data.entries.has(path) && (data.isOld(path) || data.away));
  const ages = old.map((path) => `${path} ${span(data.age(path))} old`).join(", ");
  const view = (change) => (event) => {
    leave(event);
    change(scene.current);
  };
  return html`<section class="panel picture">
    <canvas ref=${canvas} tabindex="0" role="img" aria-label=${`Map, scan and place of ${data.name}${ages ? `; ${ages}` : ""}`}></canvas>
    ${ages && html`<p class="overlay age">Not live: ${ages}</p>`}
    <p class="overlay hint">${hint(data)}</p>
    <p class="overlay scale">${data.poses.length ? "" : "in the robot's own frame; "}grid: ${(scene.current?.scale ?? 40) >= 20 ? 1 : 10} m</p>
    <div class="overlay tools">
      <button type="button" aria-label="Zoom in" onClick=${view((of) => of.zoom(1.25))}>+</button>
      <button type="button" aria-label="Zoom out" onClick=${view((of) => of.zoom(0.8))}>−</button>
      <button type="button" onClick=${view((of) => of.fit())}>Fit</button>
      ${scene.current?.follows === false && html`<button type="button" onClick=${view((of) => of.follow())}>Follow</button>`}
    </div>
  </section>`;
}

// Why nothing is to be seen around the robot.
function hint(data) {
  const [scan, map] = [data.message("scan"), data.message("map")];
  if (!scan && !map?.cells.length) return "No map and no scan received.";
  const near = scan?.ranges.some((range) => range >= scan.range_min && range < scan.range_max);
  return scan && !near && !data.isOld("scan") ? `The scanner sees nothing within ${scan.range_max.toFixed(0)} m.` : "";
}

function Camera({ data }) {
  const [shown, setShown] = useState({ message: null, address: null, broken: false });
  const message = data.message("image");
  useEffect(() => {
    if (!message || message === shown.message) return;
    if (shown.address) URL.revokeObjectURL(shown.address);
    const type = message.format === "png" ? "image/png" : "image/jpeg";
    setShown({ message, address: URL.createObjectURL(new Blob([message.data], { type })), broken: false });
  });
  useEffect(() => () => shown.address && URL.revokeObjectURL(shown.address), []);
  if (!message) return null;
  const old = data.isOld("image") || data.away;
  const broken = () => setShown((now) => ({ ...now, broken: true }));
  return html`<section class="panel camera ${old ? "old" : ""}">
    ${shown.broken && html`<p class="empty">What the camera sent is no picture.</p>`}
    ${!shown.broken && shown.address && html`<img src=${shown.address} alt=${`Camera of ${data.name}`} onError=${broken} />`}
    ${old && html`<p class="overlay age">Not live: picture ${span(data.age("image"))} old</p>`}
  </section>`;
}
