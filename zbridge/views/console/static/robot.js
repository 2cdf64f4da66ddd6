// The page of one robot: what is known of it, and its stop.

import { html } from "./vendor/htm-preact.js";
import { leave } from "./header.js";
import { since, tone } from "./fleet.js";

export function Robot({ store, name }) {
  const row = store.rows.get(name);
  if (!row) {
    return html`<section class="robot">
      <h1>${name}</h1>
      <p>Nobody knows this robot. <a href="#">All robots</a></p>
    </section>`;
  }
  const facts = [
    ["State", row.state],
    ["Why", row.reason],
    ["Last seen", row.seen === null ? "" : since(row.seen)],
    ["Driver", row.driver || "nobody"],
    ["Latched", row.latched.join("; ")],
    ["Protocol", `${row.protocol} ${row.version}`.trim()],
    ["Accepts", row.commands.join(", ")],
    ["Messages a second", row.rate === null ? "" : row.rate.toFixed(1)],
    ["Refused commands", row.refused],
    ["Lost messages", row.gaps],
    ["Host", row.host],
    ["Gateway", row.gateway],
  ].filter(([, value]) => value !== "" && value !== null);
  const stop = (event) => {
    leave(event);
    store.send({ do: "stop", robot: name });
  };
  return html`<section class="robot ${tone(row)}">
    <p><a href="#">All robots</a></p>
    <h1>${name}</h1>
    <button type="button" class="stop" aria-label=${`Stop ${name}`} onClick=${stop}>Stop</button>
    <dl>
      ${facts.map(([title, value]) => html`<dt>${title}</dt><dd>${value}</dd>`)}
    </dl>
  </section>`;
}
