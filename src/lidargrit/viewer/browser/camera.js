// Where one looks from -> the matrix that puts points on a screen. All panes share one camera.

const FIELD_OF_VIEW = Math.PI / 3.6; // 50 degrees: what a person takes in without turning the head
const NEAREST_M = 0.2;
const FARTHEST_M = 2000;

class Camera {
  // Most points of the scans to be looked at lie within reachM of the sensor.
  constructor(reachM) {
    this.reachM = Math.min(120, Math.max(4, reachM));
    this.reset();
  }

  // From behind and above, as one would follow the car, so near that the points fill the picture.
  reset() {
    this.turn = Math.PI + 0.35;
    this.tilt = 0.5;
    this.distanceM = 1.25 * this.reachM;
    this.target = [0.12 * this.reachM, 0, -1];
  }

  orbit(turn, tilt) {
    this.turn += turn;
    this.tilt = Math.min(1.55, Math.max(-1.55, this.tilt + tilt));
  }

  zoom(factor) {
    this.distanceM = Math.min(600, Math.max(1, this.distanceM * factor));
  }

  // Move what is looked at across the screen, by parts of the screen's height.
  pan(right, up) {
    const { side, top } = this.axes();
    const scale = 2 * this.distanceM * Math.tan(FIELD_OF_VIEW / 2);
    this.target = this.target.map((value, axis) => value + scale * (right * side[axis] + up * top[axis]));
  }

  axes() {
    const [ct, st] = [Math.cos(this.turn), Math.sin(this.turn)];
    const [cu, su] = [Math.cos(this.tilt), Math.sin(this.tilt)];
    return { back: [ct * cu, st * cu, su], side: [-st, ct, 0], top: [-ct * su, -st * su, cu] };
  }

  // Column by column, as WebGL takes it.
  matrix(aspect) {
    const { back, side, top } = this.axes();
    const eye = this.target.map((value, axis) => value + this.distanceM * back[axis]);
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const fy = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const fx = fy / aspect;
    const depth = (FARTHEST_M + NEAREST_M) / (NEAREST_M - FARTHEST_M);
    const shift = (2 * FARTHEST_M * NEAREST_M) / (NEAREST_M - FARTHEST_M);
    const columns = [0, 1, 2].map((axis) => [fx * side[axis], fy * top[axis], depth * back[axis], -back[axis]]);
    const last = [-fx * dot(side, eye), -fy * dot(top, eye), -depth * dot(back, eye) + shift, dot(back, eye)];
    return new Float32Array([...columns.flat(), ...last]);
  }
}

// Where a point lies on a screen of a size, and how far away it is; null behind the camera.
function onScreen(matrix, points, pixel, width, height) {
  const [x, y, z] = [points[4 * pixel], points[4 * pixel + 1], points[4 * pixel + 2]];
  const far = matrix[3] * x + matrix[7] * y + matrix[11] * z + matrix[15];
  if (far < NEAREST_M) {
    return null;
  }
  const across = (matrix[0] * x + matrix[4] * y + matrix[8] * z + matrix[12]) / far;
  const up = (matrix[1] * x + matrix[5] * y + matrix[9] * z + matrix[13]) / far;
  return [((across + 1) / 2) * width, ((1 - up) / 2) * height, far];
}

// The point nearest to a point on the screen, of two that are as near the one in front; -1 if none is near.
function pick(matrix, points, withDropped, width, height, left, top) {
  const reachPx = 12; // about half a fingertip
  let [best, chosen] = [reachPx * reachPx, -1];
  for (let pixel = 0; 4 * pixel < points.length; pixel++) {
    if (!withDropped && points[4 * pixel + 3] === 0) {
      continue;
    }
    const seen = onScreen(matrix, points, pixel, width, height);
    if (!seen) {
      continue;
    }
    const [right, down] = [seen[0] - left, seen[1] - top];
    const score = right * right + down * down + 0.3 * seen[2];
    if (score < best) {
      [best, chosen] = [score, pixel];
    }
  }
  return chosen;
}
