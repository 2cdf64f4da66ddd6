// The picture of one robot: map, trail, scan and the robot itself on a canvas that is zoomed and moved.
//
// Metres, in the robot's map frame: x to the right, y up. A robot without a pose is drawn in its own frame, forward up.

const SMALLEST = 2; // pixels a metre
const LARGEST = 500;
const STEP = 1.25;
const ROBOT_M = 0.2; // radius of the robot's picture
const COLORS = ["ground", "unknown", "free", "occupied", "old", "grid", "trail", "scan", "robot"];

export class Scene {
  constructor(canvas, data) {
    this.canvas = canvas;
    this.data = data;
    this.scale = 40;
    this.centre = { x: 0, y: 0 };
    this.follows = true;
    this.pointers = new Map();
    this.points = []; // of the scan that is drawn, metres
    this.map = { message: null, old: null, image: null };
    this.scheduled = 0;
    this.moved = () => {}; // called when somebody moves the picture
    this.observer = new ResizeObserver(() => this.schedule());
    this.observer.observe(canvas);
    this.scheme = matchMedia("(prefers-color-scheme: dark)");
    this.recolor = () => {
      this.readColors();
      this.map.message = null;
      this.schedule();
    };
    this.scheme.addEventListener("change", this.recolor);
    this.readColors();
    this.listen();
  }

  close() {
    cancelAnimationFrame(this.scheduled);
    this.scheduled = -1;
    this.observer.disconnect();
    this.scheme.removeEventListener("change", this.recolor);
  }

  readColors() {
    const style = getComputedStyle(this.canvas);
    this.colors = Object.fromEntries(COLORS.map((name) => [name, style.getPropertyValue(`--scene-${name}`).trim()]));
  }

  schedule() {
    if (this.scheduled) return;
    this.scheduled = requestAnimationFrame(() => {
      this.scheduled = 0;
      this.draw();
    });
  }

  // The view

  listen() {
    const canvas = this.canvas;
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(event.deltaY < 0 ? STEP : 1 / STEP, event);
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, event);
    });
    for (const type of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(type, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("keydown", (event) => {
      if (event.key === "+" || event.key === "=") this.zoom(STEP);
      else if (event.key === "-") this.zoom(1 / STEP);
      else if (event.key === "0") this.follow();
    });
  }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const others = [...this.pointers.values()].filter((pointer) => pointer.pointerId !== event.pointerId);
    this.pointers.set(event.pointerId, event);
    if (others.length) {
      const apart = (pointer) => Math.hypot(pointer.clientX - others[0].clientX, pointer.clientY - others[0].clientY);
      this.zoom(apart(event) / Math.max(apart(before), 1), others[0]);
      return;
    }
    this.pan(event.clientX - before.clientX, event.clientY - before.clientY);
  }

  pan(right, down) {
    const [x, y] = this.turned(-right / this.scale, down / this.scale, -1);
    this.centre = { x: this.centre.x + x, y: this.centre.y + y };
    this.setFollows(false);
  }

  // Zooms by a factor; what lies under the pointer stays there.
  zoom(factor, pointer = null) {
    const scale = Math.min(LARGEST, Math.max(SMALLEST, this.scale * factor));
    if (pointer && !this.follows) {
      const box = this.canvas.getBoundingClientRect();
      const [right, up] = [pointer.clientX - box.left - box.width / 2, box.top + box.height / 2 - pointer.clientY];
      const [x, y] = this.turned(right * (1 / this.scale - 1 / scale), up * (1 / this.scale - 1 / scale), -1);
      this.centre = { x: this.centre.x + x, y: this.centre.y + y };
    }
    this.scale = scale;
    this.schedule();
  }

  follow() {
    this.setFollows(true);
  }

  // Shows all that is drawn, and a little more.
  fit() {
    const map = this.data.message("map");
    const all = [...this.points, ...[...this.data.trail, ...this.data.poses.slice(-1)].map(({ x, y }) => [x, y])];
    if (map?.cells.length) {
      const [x, y] = map.origin;
      all.push([x, y], [x + map.columns * map.cell, y + map.rows * map.cell]);
    }
    if (!all.length) return;
    const sides = [0, 1].map((axis) => all.map((place) => place[axis])).map((values) => [Math.min(...values), Math.max(...values)]);
    const [across, along] = sides.map(([low, high]) => high - low + 2 * ROBOT_M);
    const [wide, high] = this.ownFrame ? [along, across] : [across, along];
    this.centre = { x: (sides[0][0] + sides[0][1]) / 2, y: (sides[1][0] + sides[1][1]) / 2 };
    this.setFollows(false);
    this.scale = Math.min(LARGEST, Math.max(SMALLEST, 0.95 * Math.min(this.canvas.clientWidth / wide, this.canvas.clientHeight / high)));
  }

  setFollows(follows) {
    this.follows = follows;
    this.moved();
    this.schedule();
  }

  get ownFrame() {
    return !this.data.poses.length && !this.data.message("map");
  }

  // Turns a vector from the map frame to the picture (way 1), or back (-1).
  turned(x, y, way) {
    if (!this.ownFrame) return [x, y];
    return way > 0 ? [-y, x] : [y, -x];
  }

  // What is drawn

  draw() {
    const { canvas, colors } = this;
    const ratio = devicePixelRatio;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const context = canvas.getContext("2d");
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = colors.unknown;
    context.fillRect(0, 0, canvas.width, canvas.height);
    const pose = this.data.poses.at(-1);
    if (this.follows) this.centre = pose ? { x: pose.x, y: pose.y } : { x: 0, y: 0 };
    const view = this.matrix(width, height, ratio);
    context.setTransform(...view);
    this.drawMap(context);
    this.drawGrid(context, width, height);
    this.drawTrail(context);
    this.drawScan(context, view, ratio);
    this.drawRobot(context, pose);
    canvas.dataset.view = JSON.stringify(view); // tests compare pixels with the simulated room
  }

  // From metres to pixels of the canvas, as setTransform takes it.
  matrix(width, height, ratio) {
    const scale = this.scale * ratio;
    const [right, up] = this.turned(this.centre.x, this.centre.y, 1);
    const [left, top] = [(width * ratio) / 2 - right * scale, (height * ratio) / 2 + up * scale];
    return this.ownFrame ? [0, -scale, -scale, 0, left, top] : [scale, 0, 0, -scale, left, top];
  }

  drawGrid(context, width, height) {
    const step = this.scale >= 20 ? 1 : 10;
    const reach = Math.hypot(width, height) / this.scale / 2;
    context.beginPath();
    for (const [along, across, flip] of [[this.centre.x, this.centre.y, false], [this.centre.y, this.centre.x, true]]) {
      for (let at = Math.ceil((along - reach) / step) * step; at <= along + reach; at += step) {
        const ends = [[at, across - reach], [at, across + reach]].map(([a, b]) => (flip ? [b, a] : [a, b]));
        context.moveTo(...ends[0]);
        context.lineTo(...ends[1]);
      }
    }
    this.stroke(context, this.colors.grid, 1);
  }

  stroke(context, color, pixels) {
    context.strokeStyle = color;
    context.lineWidth = pixels / this.scale;
    context.stroke();
  }

  drawMap(context) {
    const message = this.data.message("map");
    const old = this.data.isOld("map") || this.data.away;
    if (!message?.cells.length) return;
    if (this.map.message !== message || this.map.old !== old) {
      this.map = { message, old, image: mapImage(message, this.palette(old)) };
    }
    const [x, y] = message.origin;
    context.imageSmoothingEnabled = false;
    context.drawImage(this.map.image, x, y, message.columns * message.cell, message.rows * message.cell);
  }

  // An old map does not show what is free: something may stand there by now.
  palette(old) {
    const { unknown, free, occupied, old: grey } = this.colors;
    return [unknown, old ? unknown : free, old ? grey : occupied].map(channels);
  }

  drawTrail(context) {
    context.beginPath();
    for (const { x, y, begins } of this.data.trail) begins ? context.moveTo(x, y) : context.lineTo(x, y);
    this.stroke(context, this.data.isOld("pose") || this.data.away ? this.colors.old : this.colors.trail, 2);
  }

  // Points are whole pixels: they stay sharp, whatever the zoom.
  drawScan(context, view, ratio) {
    const scan = this.data.message("scan");
    this.points = [];
    if (!scan) return;
    const pose = this.data.poseAt(scan.stamp_ns) ?? { x: 0, y: 0, heading: 0 };
    const side = Math.round(3 * ratio);
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = this.data.isOld("scan") || this.data.away ? this.colors.old : this.colors.scan;
    scan.ranges.forEach((range, index) => {
      if (!(range >= scan.range_min && range < scan.range_max)) return; // at the end of the range nothing was seen
      const angle = pose.heading + scan.angle_min + index * scan.angle_increment;
      const [x, y] = [pose.x + range * Math.cos(angle), pose.y + range * Math.sin(angle)];
      this.points.push([x, y]);
      const [right, down] = [view[0] * x + view[2] * y + view[4], view[1] * x + view[3] * y + view[5]];
      context.fillRect(Math.round(right - side / 2), Math.round(down - side / 2), side, side);
    });
    context.setTransform(...view);
  }

  drawRobot(context, pose) {
    const known = pose ?? { x: 0, y: 0, heading: 0 };
    const old = this.data.away || (pose && this.data.isOld("pose"));
    const radius = Math.max(ROBOT_M, 7 / this.scale);
    const at = (angle, part) => [
      known.x + part * radius * Math.cos(known.heading + angle),
      known.y + part * radius * Math.sin(known.heading + angle),
    ];
    context.beginPath();
    context.moveTo(...at(0, 1.4));
    context.lineTo(...at(2.5, 1));
    context.lineTo(...at(Math.PI, 0.5));
    context.lineTo(...at(-2.5, 1));
    context.closePath();
    context.fillStyle = old ? this.colors.old : this.colors.robot;
    if (pose) context.fill(); // without a pose the robot is an outline in the middle
    this.stroke(context, old ? this.colors.old : this.colors.robot, 2);
  }
}

function mapImage({ rows, columns, cells }, palette) {
  const image = document.createElement("canvas");
  image.width = columns;
  image.height = rows;
  const pixels = new ImageData(columns, rows);
  const words = new Uint32Array(pixels.data.buffer);
  for (let index = 0; index < cells.length; index++) words[index] = palette[Math.min(cells[index], 2)];
  image.getContext("2d").putImageData(pixels, 0, 0);
  return image;
}

// "#rrggbb" as the four bytes of a pixel, in the machine's order.
function channels(color) {
  const bytes = [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
  return new Uint32Array(new Uint8Array([...bytes, 255]).buffer)[0];
}
