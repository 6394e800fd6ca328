// Points and colours -> a picture on a canvas: by WebGL, or without it by hand.

const VERTEX = `
attribute vec4 point;
attribute vec4 colour;
uniform mat4 camera;
uniform float size;
uniform float dropped;
varying vec3 shown;
void main() {
  gl_Position = camera * vec4(point.xyz, 1.0);
  if (point.w + dropped < 0.5) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  float far = max(gl_Position.w, 0.5);
  gl_PointSize = point.w > 0.5 ? clamp(size * 34.0 / far, size * 0.8, size * 3.0) : size * 0.6;
  shown = colour.rgb;
}`;

const FRAGMENT = `
precision mediump float;
varying vec3 shown;
void main() {
  vec2 from_middle = gl_PointCoord - 0.5;
  if (dot(from_middle, from_middle) > 0.25) discard; // a disc
  gl_FragColor = vec4(shown, 1.0);
}`;

class WebglPoints {
  constructor(canvas, gl) {
    this.canvas = canvas;
    this.gl = gl;
    this.build();
    // A computer that slept, or that has too many pages open, may take everything away and give it back.
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.build();
      this.setPoints(this.points);
      this.setColours(this.colours);
      canvas.dispatchEvent(new Event("redraw"));
    });
  }

  build() {
    const gl = this.gl;
    this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    gl.useProgram(this.program);
    gl.enable(gl.DEPTH_TEST);
    this.buffers = { point: gl.createBuffer(), colour: gl.createBuffer() };
    this.locations = Object.fromEntries(
      ["camera", "size", "dropped"].map((name) => [name, gl.getUniformLocation(this.program, name)]),
    );
  }

  setPoints(points) {
    this.points = points;
    this.fill("point", points, this.gl.FLOAT, false);
  }

  setColours(colours) {
    this.colours = colours;
    this.fill("colour", colours, this.gl.UNSIGNED_BYTE, true);
  }

  fill(name, values, type, scaled) {
    const gl = this.gl;
    const location = gl.getAttribLocation(this.program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[name]);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, 4, type, scaled, 0, 0);
  }

  draw(matrix, sizePx, withDropped) {
    const gl = this.gl;
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0, 0, 0, 0); // the page's own background shows through
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.locations.camera, false, matrix);
    gl.uniform1f(this.locations.size, sizePx);
    gl.uniform1f(this.locations.dropped, withDropped ? 1 : 0);
    gl.drawArrays(gl.POINTS, 0, this.points.length / 4);
  }

  // Browsers keep few contexts, and give them back late unless they are told.
  close() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}

// Each point a small square, the nearest on top.
class PlainPoints {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
  }

  close() {}

  setPoints(points) {
    this.points = points;
  }

  setColours(colours) {
    this.colours = new Uint32Array(colours.buffer);
  }

  draw(matrix, sizePx, withDropped) {
    const { width, height } = this.canvas;
    const picture = this.context.createImageData(width, height);
    const shown = new Uint32Array(picture.data.buffer);
    const nearest = new Float32Array(width * height).fill(Infinity);
    for (let pixel = 0; 4 * pixel < this.points.length; pixel++) {
      const seen = withDropped || this.points[4 * pixel + 3] ? onScreen(matrix, this.points, pixel, width, height) : null;
      if (!seen) {
        continue;
      }
      const grown = Math.min(3, Math.max(0.8, 34 / seen[2])); // as the vertex shader does it
      const side = Math.max(1, Math.round(sizePx * (this.points[4 * pixel + 3] ? grown : 0.6)));
      const [left, top] = [Math.round(seen[0] - side / 2), Math.round(seen[1] - side / 2)];
      for (let y = Math.max(0, top); y < Math.min(height, top + side); y++) {
        for (let x = Math.max(0, left); x < Math.min(width, left + side); x++) {
          if (seen[2] < nearest[y * width + x]) {
            nearest[y * width + x] = seen[2];
            shown[y * width + x] = this.colours[pixel];
          }
        }
      }
    }
    this.context.putImageData(picture, 0, 0);
  }
}

function drawerFor(canvas) {
  if (!hasGraphicsCard()) {
    return new PlainPoints(canvas);
  }
  // Points are squares of whole pixels already: there is nothing to smooth.
  return new WebglPoints(canvas, canvas.getContext("webgl", { antialias: false }));
}

let graphicsCard = null; // asked once: a browser keeps few contexts

// WebGL that is computed on the processor takes ten times as long as our own few lines.
function hasGraphicsCard() {
  if (graphicsCard === null) {
    const gl = document.createElement("canvas").getContext("webgl");
    const about = gl?.getExtension("WEBGL_debug_renderer_info");
    const name = about ? gl.getParameter(about.UNMASKED_RENDERER_WEBGL) : "";
    gl?.getExtension("WEBGL_lose_context")?.loseContext();
    graphicsCard = Boolean(gl) && !/swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
  }
  return graphicsCard;
}
