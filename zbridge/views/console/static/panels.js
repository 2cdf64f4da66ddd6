// What is known of one robot as text: facts, switches, refusals, sessions, history, texts, and what it publishes.

import { html } from "./vendor/htm-preact.js";
import { leave, span } from "./words.js";

const STREAMS = ["pose", "map", "scan", "motion", "image", "battery", "sensor", "text"];
const SWITCHES = ["lidar", "light", "camera"];
const ROWS = 30; // most rows of a list; the rest is counted

const clock = (seconds) => new Date(seconds * 1000).toLocaleTimeString();

// last: whether it shows what was known last, and not what is.
function Panel({ title, last, children }) {
  return html`<section class="panel ${last ? "last" : ""}"><h2>${title}${last && ", last known"}</h2>${children}</section>`;
}

// A list whose rows are made by a function; the newest first.
function Rows({ items, row, none }) {
  if (!items.length) return html`<p class="empty">${none}</p>`;
  const more = items.length - ROWS;
  return html`<ul class="rows">
    ${items.slice(0, ROWS).map(row)}
    ${more > 0 && html`<li class="empty">and ${more} more</li>`}
  </ul>`;
}

export function Facts({ row, data }) {
  const stats = data.message("@gateway/stats");
  const battery = data.message("battery");
  const process = stats?.process;
  const facts = [
    ["Protocol", `${row.protocol} ${row.version}`.trim()],
    ["Links", data.away ? "" : (data.message("status")?.links ?? []).map((link) => `${link.name}: ${link.state} ${link.peer}`).join("; ")],
    ["Battery", Number.isFinite(battery?.level) ? `${Math.round(100 * battery.level)} %${battery.charging ? ", charging" : ""}` : ""],
    ["Temperature", Number.isFinite(data.message("motion")?.temperature) ? `${data.message("motion").temperature.toFixed(1)} °C` : ""],
    ["Accepts", row.commands.join(", ")],
    ["Refused commands", row.refused],
    ["Lost messages", row.gaps],
    ["Gateway", [row.gateway && `zbridge ${row.gateway}`, row.host && `on ${row.host}`].filter(Boolean).join(" ")],
    ["Gateway processor, memory", process && !data.away ? `${(100 * process.cpu).toFixed(1)} %, ${Math.round((process.proportional_bytes ?? process.resident_bytes) / 1e6)} MB` : ""],
  ].filter(([, value]) => value !== "" && value !== null);
  return html`<${Panel} title="Robot" last=${data.away}><dl>${facts.map(([name, value]) => html`<dt>${name}</dt><dd>${value}</dd>`)}</dl><//>`;
}

export function Switches({ row, data, store }) {
  const accepted = SWITCHES.filter((name) => row.commands.includes(name));
  if (!accepted.length || !store.may("switch")) return null;
  const set = (name, on) => (event) => {
    leave(event);
    store.ask({ do: "switch", robot: row.name, name, on });
  };
  return html`<${Panel} title="Switches">
    ${accepted.map((name) => {
      const state = data.message(name)?.on;
      return html`<div class="switch" role="group" aria-label=${name}>
        <span>${name}</span>
        <button type="button" aria-pressed=${state === true} onClick=${set(name, true)}>On</button>
        <button type="button" aria-pressed=${state === false} onClick=${set(name, false)}>Off</button>
        ${state === undefined && html`<span class="empty">state not reported</span>`}
      </div>`;
    })}
  <//>`;
}

export function Sensors({ data }) {
  const sensors = data.sensors();
  if (!sensors.length) return null;
  return html`<${Panel} title="Sensors" last=${data.away}><dl class="tight">
    ${sensors.slice(0, ROWS).map(([name, path]) => {
      const reading = data.message(path);
      const value = reading ? reading.value.toFixed(3) : "cannot be read";
      const age = data.isOld(path) ? html` <span class="age">${span(data.age(path))} old</span>` : "";
      return html`<dt>${name}</dt><dd>${value} ${reading?.kind ?? ""}${reading?.fault ? " (not plausible)" : ""}${age}</dd>`;
    })}
    ${sensors.length > ROWS && html`<dt></dt><dd class="empty">and ${sensors.length - ROWS} more</dd>`}
  </dl><//>`;
}

export function History({ data }) {
  const entries = [...(data.message("@history") ?? [])].reverse();
  const row = (entry) => html`<li><time>${clock(entry.at)}</time> ${entry.text}</li>`;
  return html`<${Panel} title="Control">
    <${Rows} items=${entries} row=${row} none="No change of driver since the console started." />
  <//>`;
}

export function Refusals({ data }) {
  const refusals = data.message("control")?.refusals ?? [];
  if (!refusals.length) return null;
  const row = (each) =>
    html`<li><b>${each.count} x ${each.command}</b> of ${each.who ?? "somebody"}${each.by ? ` by ${each.by}` : ""}: ${each.reason}</li>`;
  return html`<${Panel} title="Refused lately"><${Rows} items=${refusals} row=${row} none="" /><//>`;
}

export function Sessions({ data }) {
  const sessions = data.message("@sessions");
  const row = (each) => html`<li class=${each.state === "established" ? "" : "ended"}>
    <b>${each.name}</b> ${[each.peer, each.transport, each.version && `version ${each.version}`].filter(Boolean).join(", ")}: ${each.state}
    ${each.reason ? ` (${each.reason})` : ""}
    <span class="empty"> ${each.process === "gateway" ? "" : each.process}</span>
  </li>`;
  return html`<${Panel} title="Sessions" last=${data.away}>
    <${Rows} items=${sessions ?? []} row=${row} none=${sessions ? "No process reports any." : "Asking its gateway."} />
  <//>`;
}

export function Texts({ data }) {
  const row = (text) =>
    html`<li><time>${span(data.ageOf(text.came))} ago</time> <b>${text.kind}</b> ${text.sender ?? ""} ${text.text}</li>`;
  return html`<${Panel} title="Texts"><${Rows} items=${[...data.texts].reverse()} row=${row} none="None since this page was opened." /><//>`;
}

export function Published({ data, waited }) {
  const rates = data.message("@gateway/stats")?.rates ?? {};
  const seen = new Set([...data.entries.keys()].map((path) => path.split("/")[0]));
  if (data.texts.length) seen.add("text");
  const publishes = STREAMS.filter((name) => seen.has(name));
  const not = STREAMS.filter((name) => !seen.has(name));
  const rate = (name) => (rates[name] && !data.away ? ` (${rates[name].toFixed(1)} a second)` : "");
  return html`<${Panel} title="Published" last=${data.away}>
    <p>${publishes.length ? publishes.map((name) => `${name}${rate(name)}`).join(", ") : "Nothing of the robot yet."}</p>
    ${waited && !data.away && not.length > 0 && html`<p class="empty">Not published: ${not.join(", ")}.</p>`}
  <//>`;
}
