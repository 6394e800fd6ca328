// Packed pixels in the page -> ranges, points and colours of one scan.

// One set of scans that share their rays.
class Source {
  constructor(data) {
    Object.assign(this, data); // see _source of interactive.py
    this.size = data.height * data.width;
    this.columns = data.columnStride > 1 ? `, one in ${data.columnStride} columns` : "";
    this.unpacked = new Map();
  }

  get count() {
    return this.scans.length;
  }

  // A set with fewer scans than the longest stays at its last one.
  scanIndex(index) {
    return Math.min(index, this.count - 1);
  }

  async scan(index) {
    const own = this.scanIndex(index);
    if (!this.rays) {
      this.rays = await unpackRays(this);
    }
    if (!this.unpacked.has(own)) {
      this.unpacked.set(own, await unpackScan(this, this.scans[own]));
    }
    return this.unpacked.get(own);
  }
}

async function unpackScan(source, data) {
  const steps = new Uint16Array(await unpack(data.range));
  const beside = new Float32Array(data.beside ? await unpack(data.beside) : 0); // x, y, z of points without a pixel
  let returns = 0;
  for (const step of steps) {
    returns += step > 0;
  }
  return {
    name: data.name,
    steps,
    beside,
    count: source.size + beside.length / 3, // of pixels, then of points without one
    returns, // from pixels
    hidden: data.hidden,
    reflectance: data.reflectance && new Uint8Array(await unpack(data.reflectance)),
    anomaly: data.anomaly && new Uint8Array(await unpack(data.anomaly)),
    label: data.label && new Uint8Array(await unpack(data.label)),
    filled: data.filled && new Uint8Array(await unpack(data.filled)),
  };
}

// The browser itself unpacks gzip.
async function unpack(text) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

// The unit vector of every pixel's ray: x forward, y left, z up.
async function unpackRays(source) {
  const elevation = new Float32Array(await unpack(source.elevation));
  const azimuth = new Float32Array(await unpack(source.azimuth));
  const rays = new Float32Array(3 * source.size);
  for (let pixel = 0; pixel < source.size; pixel++) {
    const row = Math.floor(pixel / source.width);
    const up = elevation[elevation.length === source.size ? pixel : row];
    const around = azimuth[azimuth.length === source.size ? pixel : pixel % source.width];
    rays[3 * pixel] = Math.cos(up) * Math.cos(around);
    rays[3 * pixel + 1] = Math.cos(up) * Math.sin(around);
    rays[3 * pixel + 2] = Math.sin(up);
  }
  return rays;
}

// What follows takes the number of a pixel, or beyond these that of a point without one.
function isReturn(source, scan, pixel) {
  return pixel >= source.size || scan.steps[pixel] > 0;
}

function rangeM(source, scan, pixel) {
  const at = 3 * (pixel - source.size);
  return at < 0 ? scan.steps[pixel] * source.rangeStepM : Math.hypot(...scan.beside.subarray(at, at + 3));
}

// x, y, z and 1 for a return, 0 for the end of a ray that did not return.
function pointsOf(source, scan) {
  const points = new Float32Array(4 * scan.count);
  for (let pixel = 0; pixel < source.size; pixel++) {
    const returned = scan.steps[pixel] > 0;
    const range = returned ? rangeM(source, scan, pixel) : source.endM;
    for (let axis = 0; axis < 3; axis++) {
      points[4 * pixel + axis] = range * source.rays[3 * pixel + axis];
    }
    points[4 * pixel + 3] = returned ? 1 : 0;
  }
  for (let pixel = source.size; pixel < scan.count; pixel++) {
    const at = 3 * (pixel - source.size);
    points.set([...scan.beside.subarray(at, at + 3), 1], 4 * pixel);
  }
  return points;
}

// What can be shown by colour: the position of a pixel on the ramp, 0 to 1; NaN where it is not known.
const POSITIONS = {
  range: (source, scan, points, [near, far]) => (pixel) =>
    Math.log(rangeM(source, scan, pixel) / near) / Math.log(far / near),
  height: (source, scan, points, [low, high]) => (pixel) => (points[4 * pixel + 2] - low) / (high - low),
  reflectance: (source, scan) => scan.reflectance && ((pixel) => scan.reflectance[pixel] / 255),
  anomaly: (source, scan) => scan.anomaly && ((pixel) => scan.anomaly[pixel] / 255),
  ring: (source) => (pixel) =>
    pixel < source.size ? Math.floor(pixel / source.width) / Math.max(1, source.height - 1) : NaN,
};

// Red, green, blue and opacity of every pixel, for points and for the range image alike.
function coloursOf(source, scan, points, look) {
  const colours = new Uint8ClampedArray(4 * scan.count).fill(255);
  const ramp = look.ramps[look.mode];
  const position = ["label", "filled"].includes(look.mode) ? null : POSITIONS[look.mode](source, scan, points, look.scales[look.mode]);
  const height = POSITIONS.height(source, scan, points, look.scales.height); // shades what has one colour
  const classOf = look.mode === "label" && scan.label && ((pixel) => source.classes[scan.label[pixel]].colour);
  for (let pixel = 0; pixel < scan.count; pixel++) {
    let colour = look.unknown;
    if (!isReturn(source, scan, pixel)) {
      colour = look.noReturn;
    } else if (position) {
      const step = Math.round(Math.min(1, Math.max(0, position(pixel))) * (ramp.length - 1));
      colour = ramp[step] ?? look.unknown;
    } else if (look.mode === "filled") {
      const share = Math.min(1, Math.max(0, height(pixel)));
      colour = (source.generated || scan.filled?.[pixel] ? look.filled : look.measured).map((part) => (0.5 + 0.5 * share) * part);
    } else if (classOf) {
      colour = classOf(pixel);
    }
    colours.set(colour, 4 * pixel);
  }
  return colours;
}
