// The last two minutes of one robot as plots: speed, sensors, and messages a second by key.

import { html, useEffect, useRef, useState } from "./vendor/htm-preact.js";
import { MINUTES_S } from "./robot_data.js";

const MOST = 8; // lines of one plot
const HEIGHT = 150;
const LABEL = 24; // characters of a label
const BY_POSE = "m/s by its pose";
const AGES = [-120, -90, -60, -30, 0];

async function loadPlot() {
  const link = Object.assign(document.createElement("link"), { rel: "stylesheet", href: "/static/vendor/uplot.css" });
  if (!document.querySelector(`link[href="${link.getAttribute("href")}"]`)) document.head.append(link);
  return (await import("./vendor/uplot.js")).default;
}

// The values that plots show now, by name. The part before ":" is the plot.
export function readValues(data) {
  const values = {};
  const current = (path) => (data.isOld(path) || data.away ? null : data.message(path));
  const speed = current("motion")?.speed;
  if (Number.isFinite(speed)) values["speed:% of full scale"] = 100 * speed;
  else values[`speed:${BY_POSE}`] = data.away ? null : data.speedByPose();
  const battery = current("battery");
  if (Number.isFinite(battery?.level)) values["sensors:battery (%)"] = 100 * battery.level;
  for (const [name, path] of data.sensors().slice(0, MOST)) {
    const [reading, kind] = [current(path), data.message(path)?.kind];
    values[`sensors:${name}${kind ? ` (${kind})` : ""}`] = reading && !reading.fault ? reading.value : null;
  }
  const rates = Object.entries(current("@gateway/stats")?.rates ?? {}).slice(0, MOST);
  for (const [name, rate] of rates) values[`rates:${name}`] = rate;
  return values;
}

export function Plots({ data }) {
  const titles = { speed: "Speed", sensors: "Sensors", rates: "Messages a second" };
  return html`${Object.entries(titles).map(([name, title]) => html`<${Plot} key=${name} name=${name} title=${title} data=${data} />`)}`;
}

function Plot({ name, title, data }) {
  const box = useRef(null);
  const plot = useRef(null);
  const [uPlot, setUPlot] = useState(null);
  const lines = [...data.history.series].filter(([line, values]) => line.startsWith(`${name}:`) && values.some((each) => each !== null));
  const labels = lines.map(([line]) => line.slice(name.length + 1));
  const shape = labels.join("\n");
  useEffect(() => void loadPlot().then((loaded) => setUPlot(() => loaded)), []);
  useEffect(() => {
    if (!uPlot || !labels.length) return undefined;
    const place = box.current;
    const made = (plot.current = new uPlot(options(labels, place.clientWidth), [[], ...labels.map(() => [])], place));
    const observer = new ResizeObserver(() => made.setSize({ width: place.clientWidth, height: HEIGHT }));
    observer.observe(place);
    return () => {
      observer.disconnect();
      made.destroy();
      plot.current = null;
    };
  }, [uPlot, shape]);
  useEffect(() => {
    const now = Date.now() / 1000;
    plot.current?.setData([data.history.at.map((at) => at - now), ...lines.map(([, values]) => values)], false);
    plot.current?.setScale("x", { min: -MINUTES_S, max: 0 });
  });
  if (!labels.length) return null;
  const named = labels.length > 1 ? title : `${title}, ${labels[0]}`;
  return html`<section class="panel plot ${labels.length > 1 ? "" : "single"}"><h2>${named}</h2>
    <div ref=${box} role="img" aria-label=${`${title}: ${labels.join(", ")}`}></div></section>`;
}

function options(labels, width) {
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(name).trim();
  const axis = { stroke: color("--dim"), grid: { stroke: color("--line"), width: 1 }, ticks: { stroke: color("--line"), width: 1 } };
  const line = (label, index) => ({ label: label.slice(0, LABEL), stroke: color(`--line-${index + 1}`), width: 1.5, points: { show: false } });
  return {
    width,
    height: HEIGHT,
    cursor: { show: false },
    legend: { live: false },
    scales: { x: { time: false }, y: { range: (_, low, high) => range(low, high, leastRange(labels)) } },
    axes: [{ ...axis, size: 28, splits: AGES, values: AGES.map((age) => (age ? `${-age} s ago` : "now")) }, { ...axis, size: 56 }],
    series: [{}, ...labels.map(line)],
  };
}

// A smaller range would show noise as if it were motion.
const leastRange = (labels) => (labels.every((label) => label.startsWith("%")) ? 10 : labels.includes(BY_POSE) ? 0.2 : 1);

// Includes zero.
function range(low, high, least) {
  const [bottom, top] = [Math.min(low ?? 0, 0), Math.max(high ?? 0, 0)];
  const room = (top - bottom) * 0.05;
  return [bottom < 0 ? bottom - room : 0, Math.max(top + room, bottom + least)];
}
