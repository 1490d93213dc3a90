// What a bench calibration shows in drawings: where the board goes, what the cameras have seen, how the
// predicted error falls.
import { h, s } from "./dom.js";
import { camera as called, number } from "./words.js";

const rad = (degrees) => (degrees * Math.PI) / 180;
const point = (x, y) => `${x.toFixed(2)} ${y.toFixed(2)}`;
const shape = (points) => `M${points.map(([x, y]) => point(x, y)).join("L")}Z`;

/** The four corners of a board in the frame of the head at zero, metres: forward, right, down. */
export function boardCorners(requested, [width, height]) {
  const [bearing, up] = [rad(requested.bearing_deg), rad(requested.height_deg)];
  const [yaw, pitch] = [bearing - rad(requested.turned_deg[0]), up - rad(requested.turned_deg[1])];
  const middle = [Math.cos(up) * Math.cos(bearing), Math.cos(up) * Math.sin(bearing), -Math.sin(up)].map((one) => one * requested.range_m);
  const right = [-Math.sin(yaw), Math.cos(yaw), 0];
  const down = [Math.sin(pitch) * Math.cos(yaw), Math.sin(pitch) * Math.sin(yaw), Math.cos(pitch)];
  return [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => middle.map((one, k) => one + (a * width * right[k]) / 2 + (b * height * down[k]) / 2));
}

/** From above, ahead upwards: the head, arcs of range, the board with the side that it shows. */
export function fromAbove(requested, size) {
  const [width, height, base] = [260, 210, 188];
  const corners = boardCorners(requested, size);
  const up = Math.max(0.6, requested.range_m * Math.cos(rad(requested.bearing_deg)), ...corners.map(([x]) => x)) + 0.15;
  const aside = Math.max(0.6, ...corners.map(([, y]) => Math.abs(y))) + 0.25;
  const scale = Math.min((base - 14) / up, (width / 2 - 8) / aside);
  const at = ([x, y]) => [width / 2 + y * scale, base - x * scale];
  const step = requested.range_m > 1.6 ? 1 : 0.5;
  const arcs = Array.from({ length: Math.ceil((up + 0.3) / step) }, (_, k) => (k + 1) * step);
  const middle = [0, 1, 2].map((k) => corners.reduce((sum, one) => sum + one[k], 0) / 4);
  const edges = [[0, 3], [1, 2]].map(([a, b]) => [0, 1].map((k) => (corners[a][k] + corners[b][k]) / 2));
  const face = rad(requested.bearing_deg - requested.turned_deg[0]);
  const towards = [middle[0] - 0.22 * Math.cos(face), middle[1] - 0.22 * Math.sin(face)];
  const [bx, by] = at(middle);
  return s("svg", { class: "sketch", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `From above: the board ${requested.description}` },
    arcs.map((r) => s("circle", { class: "arc", cx: width / 2, cy: base, r: r * scale })),
    arcs.filter((r) => r * scale < base - 8).map((r) => s("text", { class: "tickname end", x: width / 2 - 0.6 * r * scale - 3, y: base - 0.8 * r * scale }, `${number(r, step < 1 ? 1 : 0)} m`)),
    s("path", { class: "sight", d: `M${point(width / 2, base)}L${point(bx, by)}` }),
    s("path", { class: "plate", d: `M${edges.map((one) => point(...at(one))).join("L")}` }),
    s("path", { class: "face", d: `M${point(bx, by)}L${point(...at(towards))}` }),
    s("path", { class: "head", d: `M${point(width / 2 - 9, base + 8)}V${base - 5}L${point(width / 2, base - 13)}L${point(width / 2 + 9, base - 5)}V${base + 8}Z` }),
    s("text", { class: "tickname", x: width / 2, y: height - 2 }, "the head, pan 0 upwards"));
}

/** As the head at zero sees it: 120 by 80 degrees, the board as it would look. */
export function asSeen(requested, size) {
  const [width, height] = [260, 190];
  const at = ([x, y, z]) => [width / 2 + ((Math.atan2(y, x) * 180) / Math.PI) * (width / 120), height / 2 + ((Math.atan2(z, Math.hypot(x, y)) * 180) / Math.PI) * (height / 88)];
  const corners = boardCorners(requested, size);
  const part = (u, v) => corners[0].map((one, k) => one + u * (corners[1][k] - one) + v * (corners[3][k] - one));
  const fields = [];
  for (let row = 0; row < 4; row += 1) for (let column = row % 2; column < 6; column += 2) fields.push(shape([[column, row], [column + 1, row], [column + 1, row + 1], [column, row + 1]].map(([u, v]) => at(part(u / 6, v / 4)))));
  return s("svg", { class: "sketch", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `As the head sees it from pan 0, tilt 0: the board ${requested.description}` },
    s("rect", { class: "field", x: 0.5, y: 0.5, width: width - 1, height: height - 1 }),
    s("path", { class: "zero", d: `M0 ${height / 2}H${width}M${width / 2} 0V${height}` }),
    s("path", { class: "paper", d: shape(corners.map(at)) }),
    s("path", { class: "ink", d: fields.join("") }),
    s("text", { class: "tickname start", x: 5, y: height - 6 }, "60° left"), s("text", { class: "tickname end", x: width - 5, y: height - 6 }, "60° right"));
}

/** Which parts of a camera's picture have seen corners. */
export function coverage(name, image) {
  const [width, height] = image.size_px;
  const seen = image.cells.filter((count) => count > 0).length;
  const most = Math.max(12, ...image.cells);
  const shown = image.cells.map((count, k) => s("rect", { class: count ? "cell" : "unseen", x: (k % 8) * 20 + 1, y: Math.floor(k / 8) * 20 + 1, width: 18, height: 18, "fill-opacity": count ? (0.3 + (0.7 * Math.log1p(count)) / Math.log1p(most)).toFixed(2) : 1 }));
  const part = Math.round((100 * seen) / image.cells.length);
  return h("figure", { class: "coverage" },
    s("svg", { viewBox: "0 0 160 120", style: null, preserveAspectRatio: "none", class: width < height ? "upright" : null, role: "img", "aria-label": `${called(name)}: corners were seen in ${part} percent of its picture` }, shown),
    h("figcaption", {}, h("strong", {}, called(name)), ` ${part} % seen`));
}

const shownPx = (value) => number(value, value < 0.1 ? 3 : value < 10 ? 2 : 0);

/** The predicted error of a first pointing against pictures, with what is wanted; logarithmic. */
export function curve(run) {
  const [width, height, left, low] = [300, 190, 44, 166];
  const known = run.curve;
  const target = run.target_px ?? run.wanted_px;
  const values = [...known.map(([, px]) => px), target, run.counts_px].filter((one) => one > 0);
  const [top, bottom] = [Math.max(2 * target, ...values) * 1.3, Math.min(...values) / 1.5];
  const x = (pictures) => left + ((width - left - 10) * pictures) / Math.max(run.most, ...known.map(([k]) => k), 1);
  const y = (px) => low - ((low - 8) * Math.log(px / bottom)) / Math.log(top / bottom);
  const decades = [0.001, 0.01, 0.1, 1, 10, 100, 1000].filter((one) => one >= bottom && one <= top);
  const last = known.at(-1);
  const words = last ? `Predicted error of a first pointing: ${shownPx(last[1])} px after ${last[0]} pictures, wanted ${shownPx(target)} px` : "No prediction yet";
  return s("svg", { class: "curve", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": words },
    decades.map((one) => [s("path", { class: "ring", d: `M${left} ${y(one)}H${width - 10}` }), s("text", { class: "tickname end", x: left - 5, y: y(one) + 4 }, String(one))]),
    s("path", { class: "ring", d: `M${left} 8V${low}H${width - 10}` }),
    s("path", { class: "wanted", d: `M${left} ${y(target)}H${width - 10}` }),
    s("text", { class: "wanted-name end", x: width - 12, y: y(target) - 4 }, `wanted ${shownPx(target)} px`),
    run.counts_px ? [s("path", { class: "counts", d: `M${left} ${y(run.counts_px)}H${width - 10}` }), s("text", { class: "tickname start", x: left + 4, y: y(run.counts_px) - 4 }, "counts alone")] : null,
    known.length > 1 ? s("polyline", { class: "line", points: known.map(([k, px]) => `${x(k).toFixed(1)},${y(px).toFixed(1)}`).join(" ") }) : null,
    last ? s("circle", { class: "tip", cx: x(last[0]), cy: y(last[1]), r: 4 }) : null,
    s("text", { class: "tickname start", x: left, y: height - 8 }, "0"), s("text", { class: "tickname end", x: width - 10, y: height - 8 }, `${run.most} pictures`));
}
