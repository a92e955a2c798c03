// The camera's mathematics. Vectors are arrays of three numbers in world coordinates, double precision throughout;
// places in a picture are shares of its width and height from the upper left corner. Functions return new cameras.
//
// A camera circles a target: { target, distance, azimuth, elevation, fov_deg, basis, size }, angles in radians. `basis`
// holds the horizontal axes a, b and the axis u that points up, right-handed. `size` is the diagonal of the scene.
// The elevation stays just off the poles: the up vector that is sent turns with the camera and is well defined there,
// and a path recorded there, which knows the scene's up axis only, gives the same picture.

const POLE = Math.PI / 2 - 2e-5;

export const add = (p, q) => [p[0] + q[0], p[1] + q[1], p[2] + q[2]];
export const subtract = (p, q) => [p[0] - q[0], p[1] - q[1], p[2] - q[2]];
export const times = (p, s) => [p[0] * s, p[1] * s, p[2] * s];
export const dot = (p, q) => p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
export const length = (p) => Math.hypot(p[0], p[1], p[2]);
export const cross = (p, q) => [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
export const unit = (p) => {
  const most = Math.max(Math.abs(p[0]), Math.abs(p[1]), Math.abs(p[2]));
  if (!(most > 0)) return [0, 0, 0];
  const scaled = times(p, 1 / most); // squares of tiny or huge numbers would leave the range
  return times(scaled, 1 / length(scaled));
};

/** Axes { a, b, u } of a scene whose up is x, y, z, -x, -y or -z, or a vector. */
export function basisOf(up) {
  if (Array.isArray(up)) {
    const u = unit(up);
    const k = u.map(Math.abs).indexOf(Math.max(...u.map(Math.abs)));
    if (Math.abs(u[k]) > 1 - 1e-12) return basisOf((u[k] < 0 ? "-" : "") + "xyz"[k]);
    const a = unit(cross([0, 1, 2].map((i) => (i === (k + 2) % 3 ? 1 : 0)), u));
    return { a, b: cross(u, a), u };
  }
  const [a, b, u] = { x: [1, 2, 0], y: [2, 0, 1], z: [0, 1, 2] }[String(up ?? "z").replace("-", "")] ?? [0, 1, 2];
  const axis = (i, sign = 1) => [0, 1, 2].map((k) => (k === i ? sign : 0));
  const sign = String(up).startsWith("-") ? -1 : 1;
  return { a: axis(a), b: axis(b, sign), u: axis(u, sign) };
}

/** From the target to the eye, length one. */
export function direction({ azimuth, elevation, basis: { a, b, u } }) {
  const flat = add(times(a, Math.cos(azimuth)), times(b, Math.sin(azimuth)));
  return add(times(flat, Math.cos(elevation)), times(u, Math.sin(elevation)));
}

/** { eye, target, up, fov_deg } as the protocol has it. */
export function viewOf(camera) {
  const { azimuth, elevation, basis: { a, b, u } } = camera;
  const flat = add(times(a, Math.cos(azimuth)), times(b, Math.sin(azimuth)));
  return {
    eye: add(camera.target, times(direction(camera), camera.distance)),
    target: [...camera.target],
    up: add(times(flat, -Math.sin(elevation)), times(u, Math.cos(elevation))),
    fov_deg: camera.fov_deg,
  };
}

/** The camera of a view of somebody else's; a roll is left out. */
export function cameraOf(view, basis, size) {
  const offset = subtract(view.eye, view.target);
  const distance = length(offset);
  const d = unit(offset);
  const { a, b, u } = basis;
  let flat = [dot(d, a), dot(d, b)];
  const height = dot(d, u);
  if (Math.hypot(...flat) < 1e-6) {
    const up = unit(view.up ?? u);
    flat = [dot(up, a), dot(up, b)].map((x) => (height > 0 ? -x : x));
  }
  return within({
    target: [...view.target],
    distance: distance > 0 ? distance : size,
    azimuth: Math.hypot(...flat) > 0 ? Math.atan2(flat[1], flat[0]) : -Math.PI / 2,
    elevation: Math.asin(Math.max(-1, Math.min(1, height))),
    fov_deg: view.fov_deg ?? 45,
    basis,
    size,
  });
}

/** Angles and distance brought into their ranges. */
function within(camera) {
  const far = Math.max(...camera.target.map(Math.abs));
  const least = Math.max(camera.size * 1e-6, far * 1e-12, 1e-300); // nearer, the eye's digits run out
  return {
    ...camera,
    azimuth: Math.atan2(Math.sin(camera.azimuth), Math.cos(camera.azimuth)),
    elevation: Math.max(-POLE, Math.min(POLE, camera.elevation)),
    distance: Math.max(least, Math.min(camera.size * 1e3, camera.distance)),
  };
}

/** { right, up, forward } of a view, each of length one. */
export function axesOf(view) {
  const forward = unit(subtract(view.target, view.eye));
  let right = cross(forward, unit(view.up));
  if (length(right) < 1e-9) {
    const k = forward.map(Math.abs).indexOf(Math.min(...forward.map(Math.abs)));
    right = cross(forward, [0, 1, 2].map((i) => (i === k ? 1 : 0)));
  }
  right = unit(right);
  return { right, up: cross(right, forward), forward };
}

const tangent = (view) => Math.tan((view.fov_deg * Math.PI) / 360);

/** [x, y, depth] of a point: shares of the picture; depth ≤ 0 is behind the eye, where x and y mean nothing. */
export function project(view, aspect, point) {
  const { right, up, forward } = axesOf(view);
  const p = subtract(point, view.eye);
  const depth = dot(p, forward);
  const reach = depth * tangent(view);
  return [0.5 + dot(p, right) / (2 * reach * aspect), 0.5 - dot(p, up) / (2 * reach), depth];
}

/** The point that a place of the picture shows at a depth along the view axis. */
export function pointAt(view, aspect, [x, y], depth) {
  const { right, up, forward } = axesOf(view);
  const reach = depth * tangent(view) * 2;
  const sideways = add(times(right, (x - 0.5) * reach * aspect), times(up, (0.5 - y) * reach));
  return add(view.eye, add(times(forward, depth), sideways));
}

/** Turned around the target. */
export const orbit = (camera, right, up) =>
  within({ ...camera, azimuth: camera.azimuth - right, elevation: camera.elevation + up });

/** Moved so that what is at `from`, at this depth, comes to `to`. */
export function pan(camera, aspect, from, to, depth = camera.distance) {
  const view = viewOf(camera);
  const { right, up } = axesOf(view);
  const reach = depth * tangent(view) * 2;
  const shift = add(times(right, (from[0] - to[0]) * reach * aspect), times(up, (to[1] - from[1]) * reach));
  return { ...camera, target: add(camera.target, shift) };
}

/** Distances multiplied by a factor, with `anchor`, a point of the world, staying where it is in the picture. */
export function zoom(camera, factor, anchor = camera.target) {
  const { distance } = within({ ...camera, distance: camera.distance * factor });
  const done = distance / camera.distance;
  const target = add(anchor, times(subtract(camera.target, anchor), done));
  return { ...camera, target, distance };
}

/** The point becomes the centre, at the scale it is seen at now. */
export function centreOn(camera, point) {
  const view = viewOf(camera);
  const depth = dot(subtract(point, view.eye), axesOf(view).forward);
  return within({ ...camera, target: [...point], distance: depth > 0 ? depth : camera.distance });
}

/** Turned on the spot. */
export function look(camera, right, up) {
  const { eye } = viewOf(camera);
  const turned = orbit(camera, right, up);
  return { ...turned, target: subtract(eye, times(direction(turned), turned.distance)) };
}

/** Moved on its own axes (right, forward) and along the scene's up, world units. */
export function move(camera, right, up, forward) {
  const axes = axesOf(viewOf(camera));
  const shift = add(add(times(axes.right, right), times(camera.basis.u, up)), times(axes.forward, forward));
  return { ...camera, target: add(camera.target, shift) };
}

/** The whole box in the picture, from the side the camera is at. */
export function fit(camera, lower, upper, aspect) {
  const centre = lower.map((x, i) => x + (upper[i] - x) / 2);
  const axes = axesOf(viewOf({ ...camera, target: [0, 0, 0], distance: 1 }));
  const tan = tangent(camera);
  let distance = 0;
  for (let i = 0; i < 8; i++) {
    const corner = centre.map((c, k) => (i & (1 << k) ? upper[k] : lower[k]) - c);
    const depth = dot(corner, axes.forward);
    const sideways = Math.max(Math.abs(dot(corner, axes.right)) / (tan * aspect), Math.abs(dot(corner, axes.up)) / tan);
    distance = Math.max(distance, sideways * 1.08 - depth, -depth * 1.01);
  }
  return within({ ...camera, target: centre, distance: distance || camera.size });
}

/** Between two cameras, share 0…1; the shorter way round. */
export function between(from, to, share) {
  const mix = (p, q) => p + (q - p) * share;
  const turn = Math.atan2(Math.sin(to.azimuth - from.azimuth), Math.cos(to.azimuth - from.azimuth));
  return within({
    ...to,
    target: from.target.map((x, i) => mix(x, to.target[i])),
    distance: from.distance * (to.distance / from.distance) ** share,
    azimuth: from.azimuth + turn * share,
    elevation: mix(from.elevation, to.elevation),
    fov_deg: mix(from.fov_deg, to.fov_deg),
  });
}

/**
 * The path through keys [{ time, camera }] of ascending times, as `run` draws it from keyframes: a function from a time
 * to a camera. Where eye and target come close to each other, `run` turns more evenly than this.
 */
export function pathThrough(keys) {
  const views = keys.map(({ camera }) => viewOf(camera));
  const times = keys.map(({ time }) => time);
  const closed = keys.length > 2 && ["eye", "target"].every((name) => String(views[0][name]) === String(views.at(-1)[name]));
  const curve = (values) => hermite(times, values, closed);
  const eye = curve(views.map((view) => view.eye));
  const target = curve(views.map((view) => view.target));
  const zoomed = curve(views.map((view) => [Math.log(tangent(view))]));
  const { basis, size } = keys[0].camera;
  return (time) => {
    const fov_deg = (Math.atan(Math.exp(zoomed(time)[0])) * 360) / Math.PI;
    return cameraOf({ eye: eye(time), target: target(time), up: basis.u, fov_deg }, basis, size);
  };
}

/** A smooth curve through values at ascending times: the same as `shared/keyframes.py` has. */
function hermite(times, values, closed) {
  const n = times.length;
  if (n === 1) return () => values[0];
  const steps = times.slice(1).map((time, i) => time - times[i]);
  const chords = steps.map((step, i) => values[i + 1].map((x, k) => (x - values[i][k]) / step));
  const tangents = times.map((_, i) => {
    const before = i > 0 ? chords[i - 1] : chords[closed ? n - 2 : 0];
    const after = i < n - 1 ? chords[i] : chords[closed ? 0 : n - 2];
    const [past, next] = [steps[i > 0 ? i - 1 : n - 2], steps[i < n - 1 ? i : 0]];
    const slope = before.map((x, k) => (next * x + past * after[k]) / (past + next));
    const most = 1.5 * Math.min(Math.hypot(...before), Math.hypot(...after)); // so that it rests between equal keys
    const speed = Math.hypot(...slope);
    return speed > most ? slope.map((x) => (x * most) / speed) : slope;
  });
  return (time) => {
    const at = Math.min(Math.max(time, times[0]), times[n - 1]);
    let i = 0;
    while (i < n - 2 && times[i + 1] <= at) i++;
    const s = (at - times[i]) / steps[i];
    const weights = [(1 + 2 * s) * (1 - s) ** 2, s * (1 - s) ** 2 * steps[i], s * s * (3 - 2 * s), -s * s * (1 - s) * steps[i]];
    return values[i].map((x, k) =>
      weights[0] * x + weights[1] * tangents[i][k] + weights[2] * values[i + 1][k] + weights[3] * tangents[i + 1][k]);
  };
}

/** Azimuth and elevation of the views along the axes. */
export const AXIS_VIEWS = {
  top: [-Math.PI / 2, POLE],
  bottom: [-Math.PI / 2, -POLE],
  front: [-Math.PI / 2, 0],
  back: [Math.PI / 2, 0],
  left: [Math.PI, 0],
  right: [0, 0],
};
