// The fleet page: a row for each robot, of which only those in sight are drawn; one canvas for all sparklines.

import { html, useEffect, useRef, useState } from "./vendor/htm-preact.js";
import { counted, doubtOf, driverOf, leave, toneOf, whyOf, wordOf } from "./words.js";

const SPARK = 96; // width of a sparkline, pixels
const WIDE = "(min-width: 760px)";

const FIELDS = { state: wordOf, protocol: (row) => row.protocol };

const filters = { words: "", state: "", protocol: "" };

function matches(row) {
  const text = [row.name, wordOf(row), row.protocol, row.version, row.driver, row.reason, row.host].join("\n").toLowerCase();
  return (
    Object.entries(FIELDS).every(([field, read]) => !filters[field] || read(row) === filters[field]) &&
    filters.words.toLowerCase().split(/\s+/).every((word) => text.includes(word))
  );
}

function countedBy(rows, read) {
  const counts = new Map();
  for (const value of rows.map(read)) if (value) counts.set(value, (counts.get(value) ?? 0) + 1);
  return [...counts].sort(([a], [b]) => a.localeCompare(b));
}

function Choices({ name, field, rows, redraw }) {
  const choose = (value) => () => {
    filters[field] = filters[field] === value ? "" : value;
    redraw();
  };
  const found = countedBy(rows, FIELDS[field]);
  if (found.length < 2 && !filters[field]) return null;
  return html`<div class="choices" role="group" aria-label=${name}>
    ${found.map(
      ([value, count]) =>
        html`<button type="button" aria-pressed=${filters[field] === value} onClick=${choose(value)}>
          ${value} <b>${count}</b>
        </button>`,
    )}
  </div>`;
}

export function Fleet({ store }) {
  const [, turn] = useState(0);
  const redraw = () => turn((count) => count + 1);
  const all = [...store.rows.values()];
  const rows = all.filter(matches).sort((a, b) => a.severity - b.severity || a.name.localeCompare(b.name, undefined, { numeric: true }));
  const doubtful = all.filter(doubtOf).length;
  const find = (event) => {
    filters.words = event.target.value;
    redraw();
  };
  return html`<section class="fleet">
    <div class="tools">
      <h1>${counted(all.length, "robot")}${doubtful > 0 && html`, <span class="doubt">${doubtful} ${doubtful === 1 ? "needs" : "need"} attention</span>`}</h1>
      <div class="filters">
        <input type="search" aria-label="Filter robots" placeholder="Filter" value=${filters.words} onInput=${find} />
        <${Choices} name="State" field="state" rows=${all} redraw=${redraw} />
        <${Choices} name="Protocol" field="protocol" rows=${all} redraw=${redraw} />
      </div>
    </div>
    ${!all.length && html`<p class="empty">No robot is on the bus. Start a gateway: <code>zbridge run r1.toml</code></p>`}
    ${all.length > 0 && !rows.length && html`<p class="empty">No robot matches the filter.</p>`}
    ${rows.length > 0 && html`<${Table} store=${store} rows=${rows} redraw=${redraw} />`}
  </section>`;
}

function Table({ store, rows, redraw }) {
  const box = useRef(null);
  const canvas = useRef(null);
  const wide = matchMedia(WIDE).matches;
  const height = wide ? 44 : 92;
  const view = box.current ? { top: box.current.scrollTop, height: box.current.clientHeight } : { top: 0, height: 900 };
  const first = Math.max(0, Math.floor(view.top / height) - 2);
  const last = Math.min(rows.length, Math.ceil((view.top + view.height) / height) + 2);
  useEffect(() => paint(canvas.current, store, rows, first, last, height));
  return html`<div role="table" aria-label="Robots" aria-rowcount=${rows.length + 1} class="table">
    <div role="row" class="row head">
      ${["Robot", "State", "Driver", "Protocol", "msg/s", "Refused", ""].map(
        (title) => html`<span role="columnheader">${title || html`<span class="unseen">Stop</span>`}</span>`,
      )}
    </div>
    <div class="box" ref=${box} onScroll=${redraw} tabindex="0" role="rowgroup" aria-label="Robots, scrolls">
      <div class="tall" style=${{ height: `${rows.length * height}px` }}>
        ${rows.slice(first, last).map(
          (row, index) =>
            html`<${Row} key=${row.name} row=${row} store=${store} place=${first + index} top=${(first + index) * height} />`,
        )}
        <canvas ref=${canvas} aria-hidden="true" style=${{ top: `${first * height}px` }}></canvas>
      </div>
    </div>
  </div>`;
}

function Row({ row, store, place, top }) {
  const stop = (event) => {
    leave(event);
    store.stop(row.name);
  };
  const forget = (event) => {
    leave(event);
    store.ask({ do: "forget", robot: row.name });
  };
  const [missing, driver] = [row.state === "NO GATEWAY", driverOf(row)];
  const why = [doubtOf(row) && "Stop may not reach it", whyOf(row)].filter(Boolean).join("; ");
  return html`<div role="row" class="row ${toneOf(row)}" aria-rowindex=${place + 2} style=${{ top: `${top}px` }}>
    <span role="cell" class="name"><a href=${`#/robot/${encodeURIComponent(row.name)}`}>${row.name}</a></span>
    <span role="cell" class="state"><b>${wordOf(row)}</b>
      ${missing && store.may("forget") && html` <button type="button" aria-label=${`Forget ${row.name}`} onClick=${forget}>Forget</button>`}
      <span class="why" title=${why}>${why}</span></span>
    <span role="cell" class="driver ${driver ? "" : "empty"}" title=${driver}>${driver ?? "not known"}${driver === "" && "nobody"}</span>
    <span role="cell" class="protocol">${row.protocol} ${row.version}</span>
    <span role="cell" class="rate">${row.rate === null ? "" : row.rate.toFixed(1)}</span>
    <span role="cell" class="refused">${row.refused}</span>
    <span role="cell" class="act"><button type="button" class="stop" aria-label=${`Stop ${row.name}`} onClick=${stop}>Stop</button></span>
  </div>`;
}

function paint(canvas, store, rows, first, last, height) {
  const area = canvas?.parentElement.querySelector(".row .rate");
  const shown = area && getComputedStyle(area).display !== "none";
  const wide = (canvas.hidden = !shown) ? 0 : SPARK;
  const scale = devicePixelRatio;
  const tall = (last - first) * height;
  if (canvas.width !== wide * scale || canvas.height !== tall * scale) {
    canvas.width = wide * scale;
    canvas.height = tall * scale;
    canvas.style.width = `${wide}px`;
    canvas.style.height = `${tall}px`;
  }
  if (!shown) return;
  canvas.style.left = `${area.offsetLeft}px`;
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, wide, tall);
  context.strokeStyle = getComputedStyle(canvas).color;
  for (let place = first; place < last; place++) {
    const rates = store.rates.get(rows[place].name) ?? [];
    const most = Math.max(1, ...rates);
    const bottom = (place - first) * height + height - 8;
    context.beginPath();
    let before = false;
    rates.forEach((rate, step) => {
      if (rate === null) return void (before = false);
      const [x, y] = [1.5 * step, bottom - (rate / most) * (height / 2 - 8)];
      before ? context.lineTo(x, y) : context.moveTo(x, y);
      before = true;
    });
    context.stroke();
  }
}
