// The new image around the aim, much enlarged, with the residual as a vector and its sigma as an ellipse.
import { h, s } from "./dom.js";
import { number } from "./words.js";

const SIDE = 180;

export async function residualPicture(address, pointing) {
  const [dx, dy] = pointing.residual_px;
  const [sx, sy] = pointing.residual_sigma_px;
  const [aimX, aimY] = pointing.aim_px;
  const reach = Math.max(0.25, 1.6 * Math.hypot(dx, dy), 3 * sx, 3 * sy);
  const half = [0.25, 0.5, 1, 2, 5, 10, 20, 50].find((one) => one >= reach) ?? 100; // image pixels to each side
  const scale = SIDE / (2 * half);
  const canvas = h("canvas", { width: SIDE, height: SIDE });
  try {
    const answer = await fetch(address, { cache: "no-store" });
    if (answer.ok) {
      const bitmap = await createImageBitmap(await answer.blob());
      const pen = canvas.getContext("2d");
      pen.imageSmoothingEnabled = false;
      pen.setTransform(scale, 0, 0, scale, SIDE / 2 - (aimX + 0.5) * scale, SIDE / 2 - (aimY + 0.5) * scale);
      pen.drawImage(bitmap, 0, 0);
    }
  } catch {
    // the figures stand without the picture
  }
  const middle = SIDE / 2;
  const [x, y] = [middle + dx * scale, middle + dy * scale];
  const bar = half / 2;
  const over = s("svg", { viewBox: `0 0 ${SIDE} ${SIDE}`, role: "img", "aria-label": `Residual vector, ${number(dx, 3, true)} and ${number(dy, 3, true)} pixels` },
    s("path", { class: "aim", d: `M${middle} 8V${SIDE - 8}M8 ${middle}H${SIDE - 8}` }),
    s("ellipse", { class: "sigma", cx: x, cy: y, rx: Math.max(2, sx * scale), ry: Math.max(2, sy * scale) }),
    s("path", { class: "vector", d: `M${middle} ${middle}L${x} ${y}` }),
    s("circle", { class: "tip", cx: x, cy: y, r: 3 }),
    s("path", { class: "scale", d: `M10 ${SIDE - 12}h${bar * scale}` }),
    s("text", { class: "scale", x: 12, y: SIDE - 18 }, `${bar} px`));
  return h("div", { class: "enlarged" }, canvas, over);
}
