// What only a simulation knows: the point of the scene that a pixel truly shows, and where that lies in another image.
import { get } from "./api.js";

const of = (frame) => `/simulation/truth?frame_id=${encodeURIComponent(frame)}`;

/** The point of the site that a pixel of a frame truly shows, metres; null for the sky. */
export const shownBy = async (frame, [x, y]) => (await get(`${of(frame)}&x_px=${x}&y_px=${y}`)).position_in_site_m;

/** Where a point of the site truly lies when a frame was taken: `pixel_px` in it, and `position_m` in the rover frame. */
export const placeIn = (frame, [x, y, z]) => get(`${of(frame)}&x_m=${x}&y_m=${y}&z_m=${z}`);
