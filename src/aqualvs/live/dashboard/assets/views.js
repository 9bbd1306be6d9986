// Drawings of the page: the picture with its points, the views of target and vehicle, the strips.
"use strict";

const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Draw the stripe points over the picture; the canvas has the picture's pixels. */
function drawPoints(canvas, points, rig) {
  const context = canvas.getContext("2d");
  const [width] = rig.size_px;
  const scale = canvas.width / width;
  const size = Math.max(2, 3 * scale);
  points.u.forEach((u, i) => {
    context.globalAlpha = points.used[i] ? 1 : 0.4;
    context.fillStyle = rig.lasers[points.laser[i]].colour;
    context.fillRect((u + 0.5) * scale - size / 2, (points.v[i] + 0.5) * scale - size / 2, size, size);
  });
  context.globalAlpha = 1;
}

/** A canvas with metres to pixels: `right` and `ahead` as on a chart; as sharp as the screen. */
function sheet(canvas, rightSpan, aheadSpan) {
  const context = canvas.getContext("2d");
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const fine = window.devicePixelRatio || 1;
  const [across, down] = [Math.round(width * fine), Math.round(height * fine)];
  if (canvas.width !== across || canvas.height !== down) Object.assign(canvas, { width: across, height: down });
  context.setTransform(fine, 0, 0, fine, 0, 0);
  context.clearRect(0, 0, width, height);
  const margin = 16;
  const scale = Math.min((width - 16) / (2 * rightSpan), (height - 2 * margin) / aheadSpan);
  return {
    context,
    scale,
    at: (right, ahead) => [width / 2 + scale * right, height - margin - scale * ahead],
  };
}

function ranges(view, near, far, span) {
  const { context } = view;
  context.strokeStyle = ink("--line");
  context.fillStyle = ink("--quiet");
  context.font = "13px system-ui, sans-serif";
  for (const range of [near, far]) {
    const [, y] = view.at(0, range);
    context.setLineDash([5, 5]);
    context.beginPath();
    context.moveTo(...view.at(-span, range));
    context.lineTo(...view.at(span, range));
    context.stroke();
    context.setLineDash([]);
    context.fillText(`${range.toFixed(1)} m`, 4, y - 3);
  }
}

/** The vehicle at the bottom, the target's line as measured, the points from above. */
function drawTop(canvas, state, rig) {
  const [near, far] = rig.working_range_m;
  const view = sheet(canvas, 0.75 * far, 1.05 * far);
  const { context } = view;
  ranges(view, near, far, far);
  dots(view, state.points, rig, (i) => [state.points.x[i], state.points.y[i]]);
  const [x, y] = view.at(0, 0);
  context.fillStyle = ink("--ink");
  context.beginPath();
  context.moveTo(x, y - 12);
  context.lineTo(x + 9, y + 12);
  context.lineTo(x - 9, y + 12);
  context.fill();
  if (state.posture.valid === "1") {
    // From above: the target's normal is turned by yaw; its foot is at the range along it, in the
    // horizontal plane through the dome.
    targetLine(view, +state.posture.range_m / Math.cos(radians(+state.posture.pitch_deg)), +state.posture.yaw_deg, ink("--accent"), []);
  }
  if (state.setpoint) {
    targetLine(view, state.setpoint.range_m, state.setpoint.yaw_deg, ink("--ink"), [8, 6]);
  }
}

function targetLine(view, range, yawDeg, colour, dash) {
  const { context } = view;
  const yaw = radians(yawDeg);
  const [x, y] = [range * Math.sin(yaw), range * Math.cos(yaw)];
  const reach = 0.5;
  context.strokeStyle = colour;
  context.setLineDash(dash);
  context.lineWidth = 4;
  context.beginPath();
  context.moveTo(...view.at(x - reach * Math.cos(yaw), y + reach * Math.sin(yaw)));
  context.lineTo(...view.at(x + reach * Math.cos(yaw), y - reach * Math.sin(yaw)));
  context.stroke();
  context.lineWidth = 2;
  context.beginPath();
  context.moveTo(...view.at(0, 0));
  context.lineTo(...view.at(x, y));
  context.stroke();
  context.lineWidth = 1;
  context.setLineDash([]);
}

/** Every laser's points in its own plane: along the stripe and ahead. */
function drawPlane(canvas, state, rig) {
  const [near, far] = rig.working_range_m;
  const view = sheet(canvas, 0.75 * far, 1.05 * far);
  ranges(view, near, far, far);
  const { points } = state;
  const upright = rig.lasers.map((_, laser) => {
    let x = [Infinity, -Infinity];
    let z = [Infinity, -Infinity];
    points.laser.forEach((l, i) => {
      if (l !== laser || !points.used[i]) return;
      x = [Math.min(x[0], points.x[i]), Math.max(x[1], points.x[i])];
      z = [Math.min(z[0], points.z[i]), Math.max(z[1], points.z[i])];
    });
    return z[1] - z[0] > x[1] - x[0];
  });
  dots(view, points, rig, (i) => [upright[points.laser[i]] ? points.z[i] : points.x[i], points.y[i]]);
}

function dots(view, points, rig, place) {
  const { context } = view;
  points.laser.forEach((laser, i) => {
    const [x, y] = view.at(...place(i));
    context.globalAlpha = points.used[i] ? 1 : 0.35;
    context.fillStyle = rig.lasers[laser].colour;
    context.fillRect(x - 2, y - 2, 4, 4);
  });
  context.globalAlpha = 1;
}

const radians = (degrees) => (degrees * Math.PI) / 180;

/** One strip chart of the last minute: value, band of one sigma, setpoint. */
class Strip {
  constructor(element, name, unit, least, last) {
    this.element = element;
    this.least = least;
    this.data = [[], [], [], [], []];
    this.plot = null;
    this.last = last;
    this.name = `${name}, ${unit}`;
  }

  add(time, value, sigma, setpoint) {
    const low = value === null ? null : value - sigma;
    const high = value === null ? null : value + sigma;
    [time, value, low, high, setpoint].forEach((item, i) => this.data[i].push(item));
    let old = 0;
    while (this.data[0][old] < time - 60) old += 1;
    if (old) this.data.forEach((column) => column.splice(0, old));
  }

  draw() {
    if (!this.data[0].length) return;
    const { clientWidth, clientHeight } = this.element;
    if (this.plot === null) this.plot = this.make(clientWidth, clientHeight);
    if (Math.abs(this.plot.width - clientWidth) > 1) this.plot.setSize({ width: clientWidth, height: clientHeight });
    this.plot.setData(this.data);
  }

  /** Draw anew, in the colours of now. */
  redraw() {
    if (this.plot !== null) this.plot.redraw(false, true);
  }

  make(width, height) {
    const axis = { stroke: () => ink("--ink"), grid: { stroke: () => ink("--line"), width: 1 }, font: "13px system-ui", labelFont: "bold 13px system-ui" };
    const last = () => this.data[0][this.data[0].length - 1];
    return new uPlot(
      {
        width, height, cursor: { show: false }, padding: [8, 14, 2, 0],
        scales: {
          x: { time: false, range: () => [last() - 60, last()] },
          y: { range: (_, low, high) => this.limits(low, high) },
        },
        axes: [
          { ...axis, size: this.last ? 24 : 4, splits: () => [60, 50, 40, 30, 20, 10, 0].map((age) => last() - age), values: (_, ticks) => ticks.map((t) => (this.last ? `${Math.round(t - last())} s` : "")) },
          { ...axis, size: 58, space: 13, label: this.name, labelSize: 22 },
        ],
        series: [
          {},
          { stroke: () => ink("--accent"), width: 2.5, points: { show: false } },
          { stroke: "transparent", points: { show: false } },
          { stroke: "transparent", points: { show: false } },
          { stroke: () => ink("--ink"), width: 1.5, dash: [8, 6], points: { show: false } },
        ],
        bands: [{ series: [3, 2], fill: () => `${ink("--accent")}40` }],
      },
      this.data,
      this.element,
    );
  }

  limits(low, high) {
    if (low === null || high === null) return [0, 1];
    const middle = (low + high) / 2;
    const half = Math.max((0.6 * (high - low)), this.least / 2);
    return [middle - half, middle + half];
  }
}
