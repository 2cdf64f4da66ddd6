// The last two minutes of one robot as plots: speed, sensors, and messages a second by key.

import { html, useEffect, useRef, useState } from "./vendor/htm-preact.js";
import { MINUTES_S } from "./robot_data.js";

const MOST = 8; // lines of one plot
const HEIGHT = 150;
const LABEL = 24; // characters of a label

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
  else values["speed:m/s by its pose"] = data.away ? null : data.speedByPose();
  const battery = current("battery");
  if (Number.isFinite(battery?.level)) values["sensors:battery %"] = 100 * battery.level;
  for (const [name, path] of data.sensors().slice(0, MOST)) {
    const reading = current(path);
    values[`sensors:${name}`] = reading && !reading.fault ? reading.value : null;
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
    plot.current?.setData([data.history.at, ...lines.map(([, values]) => values)], false);
    plot.current?.setScale("x", { min: now - MINUTES_S, max: now });
  });
  if (!labels.length) return null;
  return html`<section class="panel plot"><h2>${title}</h2><div ref=${box} role="img" aria-label=${`${title}: ${labels.join(", ")}`}></div></section>`;
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
    scales: { x: { time: true }, y: { range: (_, low, high) => range(low, high) } },
    axes: [{ ...axis, size: 28 }, { ...axis, size: 56 }],
    series: [{}, ...labels.map(line)],
  };
}

// Includes zero, and never a range of nothing.
function range(low, high) {
  const [least, most] = [Math.min(low ?? 0, 0), Math.max(high ?? 1, 0)];
  const room = Math.max((most - least) * 0.05, 0.01);
  return [least < 0 ? least - room : 0, most + room];
}
