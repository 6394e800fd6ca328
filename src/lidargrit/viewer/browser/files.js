// The scan that is shown -> a file for other programs, made in the browser.

function returnsOf(source, scan) {
  const pixels = [];
  for (let pixel = 0; pixel < scan.count; pixel++) {
    if (isReturn(source, scan, pixel)) {
      pixels.push(pixel);
    }
  }
  return pixels;
}

// KITTI's: x, y, z and reflectance as 32-bit floats.
function binFile(source, scan, points) {
  const pixels = returnsOf(source, scan);
  const rows = new DataView(new ArrayBuffer(16 * pixels.length));
  pixels.forEach((pixel, row) => {
    for (let axis = 0; axis < 3; axis++) {
      rows.setFloat32(16 * row + 4 * axis, points[4 * pixel + axis], true);
    }
    rows.setFloat32(16 * row + 12, scan.reflectance ? scan.reflectance[pixel] / 255 : 0, true);
  });
  return [rows];
}

// PLY, with ring, reflectance and label where all points have them.
function plyFile(source, scan, points) {
  const pixels = returnsOf(source, scan);
  const withRing = scan.beside.length === 0;
  const rowBytes = 12 + (withRing ? 2 : 0) + (scan.reflectance ? 4 : 0) + (scan.label ? 4 : 0);
  const lines = [
    "ply",
    "format binary_little_endian 1.0",
    `element vertex ${pixels.length}`,
    ...["x", "y", "z"].map((axis) => `property float ${axis}`),
    ...(scan.reflectance ? ["property float intensity"] : []),
    ...(withRing ? ["property ushort ring"] : []),
    ...(scan.label ? ["property uint label"] : []),
    "end_header",
    "",
  ];
  const rows = new DataView(new ArrayBuffer(rowBytes * pixels.length));
  pixels.forEach((pixel, row) => {
    let offset = rowBytes * row;
    for (let axis = 0; axis < 3; axis++, offset += 4) {
      rows.setFloat32(offset, points[4 * pixel + axis], true);
    }
    if (scan.reflectance) {
      rows.setFloat32(offset, scan.reflectance[pixel] / 255, true);
      offset += 4;
    }
    if (withRing) {
      rows.setUint16(offset, Math.floor(pixel / source.width), true);
      offset += 2;
    }
    if (scan.label) {
      rows.setUint32(offset, source.classes[scan.label[pixel]].number, true);
    }
  });
  return [lines.join("\n"), rows];
}

function save(parts, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob(parts, { type: "application/octet-stream" }));
  link.download = name.replace(/[^\w.-]+/g, "_");
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000); // after the browser has begun to write it
}
