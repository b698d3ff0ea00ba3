"use strict";
(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const SIDES = 24; // faces around a tube
  const RINGS = 900; // at least so many along all rods together
  const FIELD = 24 * Math.PI / 180; // angle of view

  // What is shown ---------------------------------------------------------------------------

  function bytes(text) {
    const raw = atob(text);
    const out = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
    return out.buffer;
  }

  const frames = data.times.length;
  const nodes = data.nodes;
  const positions = new Float32Array(bytes(data.position)); // frames x nodes x 3
  const quaternions = new Int16Array(bytes(data.quaternion)); // frames x nodes x 4
  const measures = data.measures.map((m) => ({ ...m, values: new Uint16Array(bytes(m.values)) }));
  const MISSING = 65535;

  // what a link to the file may ask for: #frame=12&colour=twist&play=1&yaw=0.3
  const link = new URLSearchParams(location.hash.slice(1));
  const state = {
    at: 0, // frames, with a part
    playing: false,
    speed: 1,
    colour: data.colour,
    thickness: data.magnify,
    stripe: true,
  };

  // Vectors ---------------------------------------------------------------------------------

  const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [
    a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => scaled(a, 1 / (Math.hypot(...a) || 1));

  // The columns of a frame: its three directors.
  function directors(q) {
    const [w, x, y, z] = q;
    return [
      [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ];
  }

  function between(a, b, u) { // two frames, by the straight line
    const sign = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0 ? -1 : 1;
    const q = a.map((v, i) => (1 - u) * v + sign * u * b[i]);
    const size = Math.hypot(...q) || 1;
    return q.map((v) => v / size);
  }

  // Where the nodes are at a time: saved states, and straight lines between them while it plays.
  const now = { position: new Float64Array(3 * nodes), frame: [], value: [] };
  function look() {
    const first = Math.min(Math.floor(state.at), frames - 1);
    const second = Math.min(first + 1, frames - 1);
    const u = state.at - first;
    for (let i = 0; i < 3 * nodes; i++) {
      now.position[i] = (1 - u) * positions[3 * nodes * first + i]
        + u * positions[3 * nodes * second + i];
    }
    now.frame = [];
    for (let i = 0; i < nodes; i++) {
      const of = (k) => Array.from(quaternions.subarray(4 * (nodes * k + i), 4 * (nodes * k + i) + 4));
      now.frame.push(between(of(first), of(second), u));
    }
    const m = measures[state.colour];
    now.value = null;
    if (m) {
      const n = m.at === "nodes" ? nodes : nodes - 1;
      const level = (k, i) => {
        const v = m.values[n * k + i];
        return v === MISSING ? NaN : v / 65534;
      };
      now.value = Float64Array.from({ length: n }, (_, i) =>
        u === 0 ? level(first, i) : (1 - u) * level(first, i) + u * level(second, i));
    }
  }

  const point = (i) => [now.position[3 * i], now.position[3 * i + 1], now.position[3 * i + 2]];

  // Tubes -----------------------------------------------------------------------------------

  const elements = data.parts.reduce((sum, [a, b]) => sum + b - a, 0);
  const pieces = Math.max(1, Math.ceil(RINGS / elements));
  const rings = data.parts.reduce((sum, [a, b]) => sum + (b - a) * pieces + 1, 0);
  const PER = 8; // numbers a vertex: place, normal, colour, place around
  const tube = new Float32Array(rings * SIDES * PER + data.parts.length * 2 * (SIDES + 1) * PER);
  const around = Array.from({ length: SIDES }, (_, j) => {
    const angle = 2 * Math.PI * j / SIDES;
    return [Math.cos(angle), Math.sin(angle)];
  });

  function tubeFaces() {
    const out = [];
    let base = 0;
    for (const [a, b] of data.parts) {
      const count = (b - a) * pieces + 1;
      for (let r = 0; r + 1 < count; r++) {
        for (let j = 0; j < SIDES; j++) {
          const k = (j + 1) % SIDES;
          const p = base + r * SIDES, q = p + SIDES;
          out.push(p + j, p + k, q + k, p + j, q + k, q + j);
        }
      }
      base += count * SIDES;
    }
    for (let cap = 0; cap < 2 * data.parts.length; cap++) {
      for (let j = 0; j < SIDES; j++) out.push(base, base + 1 + j, base + 1 + (j + 1) % SIDES);
      base += SIDES + 1;
    }
    return new Uint32Array(out);
  }

  // A value of elements or nodes at a place along a part, in elements from its first node.
  function along(values, onNodes, first, count, s) {
    if (!values) return NaN;
    if (onNodes) {
      const i = Math.min(Math.floor(s), count - 1), u = s - i;
      return u === 0 ? values[first + i] : (1 - u) * values[first + i] + u * values[first + i + 1];
    }
    const c = Math.min(Math.max(s - 0.5, 0), count - 1);
    const i = Math.min(Math.floor(c), Math.max(count - 2, 0)), u = c - i;
    const a = values[first + i], b = values[first + Math.min(i + 1, count - 1)];
    return u === 0 ? a : u === 1 ? b : (1 - u) * a + u * b;
  }

  function buildTubes() {
    look();
    const m = measures[state.colour];
    const onNodes = m && m.at === "nodes";
    const caps = [];
    let at = 0;
    const vertex = (x, y, z, n, v, u) => {
      tube[at++] = x; tube[at++] = y; tube[at++] = z;
      tube[at++] = n[0]; tube[at++] = n[1]; tube[at++] = n[2];
      tube[at++] = v; tube[at++] = u;
    };
    const normal = [0, 0, 0];
    for (const [first, last] of data.parts) {
      const count = last - first;
      for (let r = 0; r <= count * pieces; r++) {
        const e = Math.min(Math.floor(r / pieces), count - 1);
        const u = r / pieces - e;
        const i = first + e;
        const p = point(i), q = point(i + 1);
        const edge = add(q, p, -1);
        const length = Math.hypot(...edge);
        const t0 = directors(now.frame[i])[2], t1 = directors(now.frame[i + 1])[2];
        const a = add(scaled(t0, length), edge, -1), b = add(edge, scaled(t1, length), -1);
        const bulge = add(scaled(a, 1 - u), b, u);
        const centre = add(add(p, edge, u), bulge, u * (1 - u));
        const d = directors(between(now.frame[i], now.frame[i + 1], u));
        const s = e + u;
        const radius = 0.5 * state.thickness * along(data.diameter, false, first, count, s);
        const found = along(now.value, onNodes, first, count, s);
        const value = Number.isFinite(found) ? found : -1;
        if (r === 0) caps.push([centre, scaled(d[2], -1), value, at]);
        if (r === count * pieces) caps.push([centre, d[2], value, at]);
        for (const [c, w] of around) {
          for (let k = 0; k < 3; k++) normal[k] = c * d[0][k] + w * d[1][k];
          vertex(centre[0] + radius * normal[0], centre[1] + radius * normal[1],
            centre[2] + radius * normal[2], normal, value, c);
        }
      }
    }
    for (const [centre, outwards, value, ring] of caps) {
      vertex(...centre, outwards, value, -1);
      for (let j = 0; j < SIDES; j++) {
        const k = ring + PER * j;
        vertex(tube[k], tube[k + 1], tube[k + 2], outwards, value, -1);
      }
    }
  }

  // Obstacles and holds ---------------------------------------------------------------------

  // Triangles and lines of a grid of points.
  function patch(rows, columns, points) {
    const at = (i, j) => [0, 1, 2].map((k) => points[3 * (i * columns + j) + k]);
    const vertices = [], faces = [], lines = [];
    for (let i = 0; i < rows; i++) {
      for (let j = 0; j < columns; j++) {
        const dx = add(at(Math.min(i + 1, rows - 1), j), at(Math.max(i - 1, 0), j), -1);
        const dy = add(at(i, Math.min(j + 1, columns - 1)), at(i, Math.max(j - 1, 0)), -1);
        vertices.push(...at(i, j), ...unit(cross(dx, dy)));
        const p = i * columns + j;
        if (i + 1 < rows && j + 1 < columns) {
          faces.push(p, p + 1, p + columns + 1, p, p + columns + 1, p + columns);
        }
        if (i + 1 < rows) lines.push(p, p + columns);
        if (j + 1 < columns) lines.push(p, p + 1);
      }
    }
    return { vertices, faces, lines };
  }

  function ball() {
    const points = [];
    for (let i = 0; i <= 12; i++) {
      for (let j = 0; j <= 24; j++) {
        const a = Math.PI * i / 12, b = 2 * Math.PI * j / 24;
        points.push(Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a));
      }
    }
    const made = patch(13, 25, points);
    for (let v = 0; v < made.vertices.length; v += 6) { // normals of the poles too
      for (let k = 0; k < 3; k++) made.vertices[v + 3 + k] = made.vertices[v + k];
    }
    return made;
  }

  function box() {
    const vertices = [], faces = [];
    for (let axis = 0; axis < 3; axis++) {
      for (const side of [-1, 1]) {
        const base = vertices.length / 6;
        for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
          const p = [0, 0, 0], n = [0, 0, 0];
          p[axis] = n[axis] = side;
          p[(axis + 1) % 3] = u;
          p[(axis + 2) % 3] = v;
          vertices.push(...p, ...n);
        }
        faces.push(base, base + 1, base + 2, base, base + 2, base + 3);
      }
    }
    return { vertices, faces, lines: [] };
  }

  // The picture -----------------------------------------------------------------------------

  const canvas = byId("picture"), labels = byId("labels"), pen = labels.getContext("2d");
  const gl = canvas.getContext("webgl2", {
    alpha: false, antialias: true, preserveDrawingBuffer: true,
  });
  if (!gl || !frames) {
    byId("trouble").style.display = "flex";
    byId("trouble").textContent = frames
      ? "This browser gives the page no WebGL 2, which the picture needs."
      : "There is nothing to show.";
    document.body.dataset.ready = frames ? "no webgl" : "empty";
    canvas.style.display = "none";
    if (!gl) return;
  }

  function program(vertex, fragment) {
    const made = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, "#version 300 es\nprecision highp float;\n" + source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) {
        throw new Error(gl.getShaderInfoLog(shader));
      }
      gl.attachShader(made, shader);
    }
    gl.bindAttribLocation(made, 0, "place");
    gl.bindAttribLocation(made, 1, "normal");
    gl.bindAttribLocation(made, 2, "extra");
    gl.linkProgram(made);
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
      const name = gl.getActiveUniform(made, i).name;
      uniforms[name] = gl.getUniformLocation(made, name);
    }
    return { made, uniforms };
  }

  const LIGHT = `
    uniform vec3 eye, light;
    vec3 lit(vec3 colour, vec3 at, vec3 n) {
      vec3 towards = normalize(eye - at);
      if (dot(n, towards) < 0.0) n = -n;
      float diffuse = max(dot(n, light), 0.0);
      float sheen = pow(max(dot(n, normalize(light + towards)), 0.0), 40.0);
      float rim = 0.5 + 0.5 * dot(n, towards);
      return colour * (0.34 + 0.3 * rim + 0.42 * diffuse) + 0.14 * sheen;
    }`;
  const VERTEX = `
    in vec3 place, normal; in vec2 extra;
    uniform mat4 camera, model; out vec3 at, n; out vec2 more;
    void main() {
      vec4 world = model * vec4(place, 1.0);
      at = world.xyz; n = mat3(model) * normal; more = extra; gl_Position = camera * world;
    }`;
  const tubes = program(VERTEX, LIGHT + `
    in vec3 at, n; in vec2 more; out vec4 result;
    uniform sampler2D colours; uniform float stripe;
    void main() {
      vec3 base = more.x < -0.001 ? vec3(0.62)
        : texture(colours, vec2(0.002 + 0.996 * more.x, 0.5)).rgb;
      float edge = fwidth(more.y) + 1e-4;
      base = mix(base, vec3(0.06), stripe * smoothstep(0.9 - edge, 0.9 + edge, more.y));
      result = vec4(lit(base, at, normalize(n)), 1.0);
    }`);
  const solids = program(VERTEX, LIGHT + `
    in vec3 at, n; out vec4 result; uniform vec4 colour; uniform float flat_;
    void main() {
      result = vec4(flat_ > 0.5 ? colour.rgb : lit(colour.rgb, at, normalize(n)), colour.a);
    }`);

  function arrays(vertices, faces, per, lines) {
    const vao = gl.createVertexArray();
    gl.bindVertexArray(vao);
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(vertices), gl.DYNAMIC_DRAW);
    [[0, 3, 0], [1, 3, 12], [2, 2, 24]].forEach(([index, size, offset]) => {
      if (offset >= 4 * per) return;
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, size, gl.FLOAT, false, 4 * per, offset);
    });
    const index = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, index);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(faces), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    const made = { vao, buffer, count: faces.length };
    if (lines && lines.length) made.edges = arrays(vertices, lines, per);
    return made;
  }

  const mesh = (made) => arrays(made.vertices, made.faces, 6, made.lines);
  const tubeMesh = arrays(tube, frames ? tubeFaces() : [], PER);
  const ballMesh = mesh(ball()), boxMesh = mesh(box());
  const bodies = data.bodies.map((body) => ({
    ...body,
    meshes: [
      ...body.patches.map((p) =>
        mesh(patch(p.rows, p.columns, new Float32Array(bytes(p.points))))),
      ...(body.mesh ? [arrays(new Float32Array(bytes(body.mesh.vertices)),
        new Uint32Array(bytes(body.mesh.faces)), 6)] : []),
    ],
    shift: body.shift ? new Float32Array(bytes(body.shift)) : null,
  }));

  const texture = gl.createTexture();
  function setColours() {
    const m = measures[state.colour];
    const stops = data.colours[m && m.scale === "signed" ? "signed" : "one"];
    const row = new Uint8Array(256 * 4);
    for (let i = 0; i < 256; i++) {
      const c = i / 255 * (stops.length - 1), k = Math.min(Math.floor(c), stops.length - 2);
      for (let j = 0; j < 3; j++) {
        row[4 * i + j] = Math.round(stops[k][j] + (c - k) * (stops[k + 1][j] - stops[k][j]));
      }
      row[4 * i + 3] = 255;
    }
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, row);
    for (const [key, value] of [
      [gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
    ]) gl.texParameteri(gl.TEXTURE_2D, key, value);
    state.row = row;
  }

  // The camera ------------------------------------------------------------------------------

  const [RIGHT, UP, TOWARDS] = data.axes;
  const camera = {};
  function home() {
    let low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let i = 0; i < positions.length / 3; i++) {
      const p = [positions[3 * i], positions[3 * i + 1], positions[3 * i + 2]];
      [RIGHT, UP, TOWARDS].forEach((axis, k) => {
        const c = dot(p, axis);
        low[k] = Math.min(low[k], c);
        high[k] = Math.max(high[k], c);
      });
    }
    const middle = low.map((v, k) => 0.5 * (v + high[k]));
    camera.target = [0, 1, 2].map((j) =>
      middle[0] * RIGHT[j] + middle[1] * UP[j] + middle[2] * TOWARDS[j]);
    camera.half = low.map((v, k) => 0.5 * (high[k] - v) + data.size * 0.02);
    camera.yaw = link.has("yaw") ? Number(link.get("yaw")) : data.yaw;
    camera.pitch = link.has("pitch") ? Number(link.get("pitch")) : data.pitch;
    const aspect = canvas.clientWidth / Math.max(canvas.clientHeight, 1);
    const [w, h, d] = camera.half;
    const c = Math.cos(camera.yaw), s = Math.abs(Math.sin(camera.yaw));
    const width = w * c + d * s, depth = w * s + d * c;
    const height = h * Math.cos(camera.pitch) + depth * Math.abs(Math.sin(camera.pitch));
    // beside the scale of colours, if there is one
    const beside = measures[state.colour] ? Math.min(100 / canvas.clientWidth, 0.3) : 0;
    const need = Math.max(1.2 * height, 1.12 * width / (Math.max(aspect, 0.1) * (1 - beside)));
    camera.distance = need / Math.tan(FIELD / 2) + depth;
    const shift = camera.distance * Math.tan(FIELD / 2) * aspect * beside;
    camera.target = add(camera.target, eyeOf().right, shift);
  }

  function eyeOf() {
    const flat = add(scaled(TOWARDS, Math.cos(camera.yaw)), RIGHT, Math.sin(camera.yaw));
    const back = add(scaled(flat, Math.cos(camera.pitch)), UP, Math.sin(camera.pitch));
    const right = unit(cross(UP, back));
    return { back, right, up: cross(back, right), eye: add(camera.target, back, camera.distance) };
  }

  function cameraMatrix(view, aspect) {
    const f = 1 / Math.tan(FIELD / 2);
    const near = Math.max(camera.distance - 6 * data.size, camera.distance * 0.02);
    const far = camera.distance + 6 * data.size;
    const rows = [view.right, view.up, view.back];
    const shift = rows.map((row) => -dot(row, view.eye));
    const a = (far + near) / (near - far), b = 2 * far * near / (near - far);
    const out = new Float32Array(16);
    for (let j = 0; j < 4; j++) {
      const v = rows.map((row, i) => (j < 3 ? row[j] : shift[i]));
      out[4 * j] = f / aspect * v[0];
      out[4 * j + 1] = f * v[1];
      out[4 * j + 2] = a * v[2] + (j === 3 ? b : 0);
      out[4 * j + 3] = -v[2];
    }
    return out;
  }

  function onPage(matrix, p) {
    const v = [0, 1, 3].map((i) =>
      matrix[i] * p[0] + matrix[4 + i] * p[1] + matrix[8 + i] * p[2] + matrix[12 + i]);
    const w = canvas.clientWidth, h = canvas.clientHeight;
    return [w * (0.5 + 0.5 * v[0] / v[2]), h * (0.5 - 0.5 * v[1] / v[2])];
  }

  // Drawing ---------------------------------------------------------------------------------

  const IDENTITY = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
  function placed(columns, origin, size) {
    const out = new Float32Array(16);
    columns.forEach((c, j) => { for (let i = 0; i < 3; i++) out[4 * j + i] = c[i] * size[j]; });
    out.set(origin, 12);
    out[15] = 1;
    return out;
  }

  function paint(made, model, colour, lines = false) {
    gl.uniformMatrix4fv(solids.uniforms.model, false, model);
    gl.uniform4fv(solids.uniforms.colour, colour);
    gl.uniform1f(solids.uniforms.flat_, lines ? 1 : 0);
    const it = lines ? made.edges : made;
    gl.bindVertexArray(it.vao);
    gl.drawElements(lines ? gl.LINES : gl.TRIANGLES, it.count, gl.UNSIGNED_INT, 0);
  }

  function timeNow() {
    const k = Math.min(Math.floor(state.at), frames - 1), u = state.at - k;
    return u === 0 ? data.times[k] : (1 - u) * data.times[k] + u * data.times[k + 1];
  }

  function holdNow(hold, time) {
    let found = hold.spans[0];
    for (const span of hold.spans) if (span.after === null || span.after <= time) found = span;
    return found;
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    for (const it of [canvas, labels]) {
      if (it.width !== Math.round(width * ratio) || it.height !== Math.round(height * ratio)) {
        it.width = Math.round(width * ratio);
        it.height = Math.round(height * ratio);
      }
    }
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.957, 0.965, 0.973, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    const view = eyeOf();
    const matrix = cameraMatrix(view, width / Math.max(height, 1));
    const light = unit(add(add(scaled(view.right, -0.45), view.up, 0.7), view.back, 0.7));
    const common = (it) => {
      gl.useProgram(it.made);
      gl.uniformMatrix4fv(it.uniforms.camera, false, matrix);
      gl.uniform3fv(it.uniforms.eye, view.eye);
      gl.uniform3fv(it.uniforms.light, light);
    };
    common(tubes);
    gl.uniformMatrix4fv(tubes.uniforms.model, false, IDENTITY);
    gl.uniform1f(tubes.uniforms.stripe, state.stripe ? 1 : 0);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.bindVertexArray(tubeMesh.vao);
    gl.drawElements(gl.TRIANGLES, tubeMesh.count, gl.UNSIGNED_INT, 0);

    common(solids);
    const time = timeNow();
    for (const hold of data.holds) {
      const span = holdNow(hold, time);
      if (!span.kind) continue;
      const frame = directors(now.frame[hold.node]), origin = point(hold.node);
      const thick = state.thickness * data.diameter[Math.min(hold.node, nodes - 2)];
      const size = Math.max(0.011 * data.size, 0.75 * thick);
      const dark = [0.23, 0.27, 0.32, 1];
      if (span.kind === "ball") {
        paint(ballMesh, placed(frame, origin, [size, size, size]), dark);
      } else {
        paint(boxMesh, placed(frame, origin, [1.25 * size, 0.95 * size, 0.3 * size]), dark);
      }
      if (span.axis) { // what it may slide along
        const a = unit(span.axis);
        const b = unit(cross(a, Math.abs(a[0]) < 0.8 ? [1, 0, 0] : [0, 1, 0]));
        const rail = placed([a, b, cross(a, b)], origin, [9 * size, 0.12 * size, 0.12 * size]);
        paint(boxMesh, rail, [0.45, 0.5, 0.56, 1]);
      }
    }
    for (const lump of data.lumps) {
      const frame = directors(now.frame[lump.node]);
      let centre = point(lump.node);
      frame.forEach((d, k) => { centre = add(centre, d, lump.offset[k]); });
      const thick = state.thickness * data.diameter[Math.min(lump.node, nodes - 2)];
      const brown = [0.72, 0.5, 0.3, 1];
      if (lump.halves) { // a box; its axes are given in the frame of the node
        const sides = lump.axes.map((a) => add(add(scaled(frame[0], a[0]), frame[1], a[1]), frame[2], a[2]));
        paint(boxMesh, placed(sides, centre, lump.halves), brown);
        continue;
      }
      const size = lump.radius || Math.max(0.015 * data.size, 0.9 * thick);
      paint(ballMesh, placed(frame, centre, [size, size, size]), brown);
    }
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    const k = Math.min(Math.floor(state.at), frames - 1), after = Math.min(k + 1, frames - 1);
    const u = state.at - k;
    for (const body of bodies) {
      const shift = [0, 1, 2].map((i) => (body.shift
        ? (1 - u) * body.shift[3 * k + i] + u * body.shift[3 * after + i] : 0));
      const model = placed([[1, 0, 0], [0, 1, 0], [0, 0, 1]], shift, [1, 1, 1]);
      for (const made of body.meshes) {
        paint(made, model, [0.62, 0.68, 0.75, body.inside ? 0.22 : 0.5]);
        if (made.edges) paint(made, model, [0.35, 0.42, 0.5, 0.25], true);
      }
    }
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(null);
    write(ratio, matrix, view);
    const t = `t = ${number(time, 4)} ${data.units.time}`;
    byId("time").textContent = frames > 1 || time ? t : "";
    byId("frame").value = Math.round(state.at);
  }

  // Words and scales ------------------------------------------------------------------------

  function number(v, digits = 3) {
    if (v === 0) return "0";
    const size = Math.abs(v);
    const text = size >= 1e5 || size < 1e-3 ? v.toExponential(digits - 1) : v.toPrecision(digits);
    const [mantissa, power] = text.split("e");
    const short = mantissa.includes(".") ? mantissa.replace(/\.?0+$/, "") : mantissa;
    return (power ? `${short}e${power.replace("+", "")}` : short).replace("-", "\u2212");
  }

  function nice(size) { // the next smaller of 1, 2, 5 times a power of ten
    const power = 10 ** Math.floor(Math.log10(size));
    const lead = size / power;
    return power * (lead >= 5 ? 5 : lead >= 2 ? 2 : 1);
  }

  function ticks(m) {
    if (m.scale === "log") {
      const out = [];
      for (let p = Math.ceil(m.low - 1e-9); p <= m.high + 1e-9; p++) {
        out.push([(p - m.low) / (m.high - m.low), 10 ** p]);
      }
      if (out.length > 1) return out;
      return [[0, 10 ** m.low], [1, 10 ** m.high]];
    }
    const step = nice((m.high - m.low) / 3.5), out = [];
    for (let v = Math.ceil(m.low / step - 1e-6) * step; v <= m.high + 1e-6 * step; v += step) {
      out.push([(v - m.low) / (m.high - m.low), Math.abs(v) < 1e-9 * step ? 0 : v]);
    }
    return out;
  }

  function write(ratio, matrix, view) {
    const width = canvas.clientWidth, height = canvas.clientHeight;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = "12px system-ui, 'Segoe UI', Helvetica, Arial, sans-serif";
    pen.fillStyle = pen.strokeStyle = "#20262d";
    pen.lineWidth = 1;
    const m = measures[state.colour];
    if (m) { // the colour bar
      const tall = Math.min(220, 0.5 * height), left = width - 84, top = 46;
      const label = m.unit ? `${m.name} [${m.unit}]` : m.name;
      pen.textAlign = "right";
      pen.textBaseline = "middle";
      pen.fillText(label, width - 12, top - 20);
      for (let i = 0; i < tall; i++) {
        const c = 4 * Math.round(255 * (1 - i / (tall - 1)));
        pen.fillStyle = `rgb(${state.row[c]},${state.row[c + 1]},${state.row[c + 2]})`;
        pen.fillRect(left, top + i, 14, 1.5);
      }
      pen.strokeRect(left - 0.5, top - 0.5, 15, tall + 1);
      pen.fillStyle = "#20262d";
      pen.textAlign = "left";
      for (const [place, value] of ticks(m)) {
        const y = top + (1 - place) * (tall - 1);
        pen.beginPath();
        pen.moveTo(left + 14, y);
        pen.lineTo(left + 18, y);
        pen.stroke();
        pen.fillText(number(value), left + 22, y);
      }
    }
    // a length at the distance of the middle
    const across = 2 * camera.distance * Math.tan(FIELD / 2) / height; // a pixel there
    const bar = nice(across * Math.min(160, 0.25 * width));
    const pixels = bar / across;
    const x = width - 20 - pixels, y = height - 18;
    pen.textAlign = "center";
    pen.textBaseline = "bottom";
    pen.beginPath();
    pen.moveTo(x, y - 4); pen.lineTo(x, y); pen.lineTo(x + pixels, y); pen.lineTo(x + pixels, y - 4);
    pen.stroke();
    pen.fillText(`${number(bar)} ${data.units.length}`, x + pixels / 2, y - 3);
    // the inertial directions, the nearest drawn last
    const origin = [44, height - 44];
    const arrows = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((e, i) => ({
      name: `e${i + 1}`, x: dot(e, view.right), y: -dot(e, view.up), z: dot(e, view.back),
      colour: ["#c0392b", "#1e8449", "#2457a8"][i],
    })).sort((a, b) => a.z - b.z);
    pen.textBaseline = "middle";
    for (const arrow of arrows) {
      pen.strokeStyle = pen.fillStyle = arrow.colour;
      pen.lineWidth = 2;
      pen.beginPath();
      pen.moveTo(...origin);
      pen.lineTo(origin[0] + 26 * arrow.x, origin[1] + 26 * arrow.y);
      pen.stroke();
      pen.fillText(arrow.name, origin[0] + 36 * arrow.x, origin[1] + 36 * arrow.y);
    }
    // where each rod begins
    pen.fillStyle = "#5b6672";
    pen.textAlign = "left";
    data.parts.forEach(([first], i) => {
      const [px, py] = onPage(matrix, point(first));
      const radius = 0.5 * state.thickness * data.diameter[first] / across;
      const words = data.parts.length > 1 ? `s = 0 of rod ${i}` : "s = 0";
      pen.fillText(words, px + 8, py - radius - 14);
    });
  }

  // Controls --------------------------------------------------------------------------------

  let asked = false;
  function redraw(tubesToo) {
    redraw.tubes = redraw.tubes || tubesToo;
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      refresh();
    });
  }
  function refresh() {
    if (!frames) return;
    if (redraw.tubes !== false) {
      buildTubes();
      gl.bindBuffer(gl.ARRAY_BUFFER, tubeMesh.buffer);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, tube);
      redraw.tubes = false;
    }
    draw();
  }

  function play(on) {
    state.playing = on && frames > 1;
    byId("play").textContent = state.playing ? "\u275A\u275A" : "\u25B6";
    if (!state.playing) {
      state.at = Math.round(state.at);
      redraw(true);
      return;
    }
    if (state.at >= frames - 1) state.at = 0;
    const span = data.times[frames - 1] - data.times[0];
    let last = null, time = timeNow();
    const tick = (clock) => {
      if (!state.playing) return;
      if (last !== null) {
        time += state.speed * span * Math.min(clock - last, 400) / (1000 * data.seconds);
        let k = Math.floor(state.at);
        while (k + 1 < frames && data.times[k + 1] <= time) k++;
        const step = data.times[k + 1] - data.times[k];
        state.at = k + 1 < frames ? k + Math.min(Math.max((time - data.times[k]) / step, 0), 1) : k;
        if (k >= frames - 1) {
          play(false);
          return;
        }
        redraw.tubes = true;
        refresh();
      }
      last = clock;
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  function show(index) {
    state.at = Math.min(Math.max(index, 0), frames - 1);
    redraw(true);
  }

  const choices = (id, list, chosen, act) => {
    const select = byId(id);
    list.forEach(([label, value]) => {
      const option = document.createElement("option");
      option.textContent = label;
      option.value = value;
      select.append(option);
    });
    select.value = chosen;
    select.addEventListener("change", () => act(Number(select.value)));
  };
  choices("speed", [0.1, 0.25, 0.5, 1, 2, 4].map((v) => [`\u00D7${v}`, v]), 1, (v) => {
    state.speed = v;
  });
  choices("colour", [["none", -1], ...measures.map((m, i) => [m.name, i])], state.colour, (v) => {
    state.colour = v;
    setColours();
    redraw(true);
  });
  const thick = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];
  if (!thick.includes(state.thickness)) thick.push(state.thickness);
  thick.sort((a, b) => a - b);
  choices("thickness", thick.map((v) => [v === 1 ? "true" : `\u00D7${v}`, v]), state.thickness,
    (v) => {
      state.thickness = v;
      notes();
      redraw(true);
    });
  byId("stripe").addEventListener("change", (event) => {
    state.stripe = event.target.checked;
    redraw(false);
  });
  byId("home").addEventListener("click", () => {
    home();
    redraw(false);
  });
  byId("play").addEventListener("click", () => play(!state.playing));
  byId("frame").max = Math.max(frames - 1, 0);
  byId("frame").addEventListener("input", (event) => {
    if (state.playing) play(false);
    show(Number(event.target.value));
  });
  const idle = frames ? ["play", "frame"]
    : ["play", "frame", "speed", "colour", "thickness", "stripe", "home"];
  if (frames < 2) idle.forEach((id) => { byId(id).disabled = true; });

  let held = null, touched = false;
  canvas.addEventListener("pointerdown", (event) => {
    held = { x: event.clientX, y: event.clientY, pan: event.shiftKey || event.button === 2 };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    touched = true;
    const dx = event.clientX - held.x, dy = event.clientY - held.y;
    held.x = event.clientX;
    held.y = event.clientY;
    if (held.pan) {
      const view = eyeOf();
      const pixel = 2 * camera.distance * Math.tan(FIELD / 2) / canvas.clientHeight;
      camera.target = add(add(camera.target, view.right, -dx * pixel), view.up, dy * pixel);
    } else {
      camera.yaw -= dx * 0.008;
      camera.pitch = Math.min(Math.max(camera.pitch + dy * 0.008, -1.55), 1.55);
    }
    redraw(false);
  });
  ["pointerup", "pointercancel"].forEach((name) =>
    canvas.addEventListener(name, () => { held = null; }));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    touched = true;
    camera.distance *= Math.exp(0.0012 * event.deltaY);
    redraw(false);
  }, { passive: false });
  window.addEventListener("keydown", (event) => {
    if (event.target.tagName === "SELECT") return;
    const steps = { ArrowRight: 1, ArrowLeft: -1, Home: -frames, End: frames };
    if (event.key === " ") play(!state.playing);
    else if (event.key in steps) show(Math.round(state.at) + steps[event.key]);
    else return;
    event.preventDefault();
  });

  function notes() {
    byId("notes").replaceChildren(...data.notes.filter((n) => n.text).map((note) => {
      const line = document.createElement("div");
      line.textContent = note.text;
      if (note.alarm) line.className = "alarm";
      return line;
    }));
    if (state.thickness !== 1 && frames) {
      const line = document.createElement("div");
      line.textContent = `tubes drawn ${state.thickness} times as thick as they are`;
      byId("notes").append(line);
    }
  }

  byId("title").textContent = data.title;
  notes();
  if (!frames) return;
  setColours();
  home();
  const wanted = measures.findIndex((m) => m.name === link.get("colour"));
  if (wanted >= 0) {
    state.colour = wanted;
    byId("colour").value = wanted;
    setColours();
  }
  if (link.has("distance")) camera.distance = Number(link.get("distance"));
  if (link.has("thickness")) {
    state.thickness = Number(link.get("thickness"));
    byId("thickness").value = state.thickness;
    notes();
  }
  if (link.has("frame")) state.at = Math.min(Number(link.get("frame")), frames - 1);
  new ResizeObserver(() => {
    if (!touched && !link.has("distance")) home();
    refresh(); // at once: what is stretched to the new size is never seen
  }).observe(canvas);
  refresh();
  document.body.dataset.ready = "yes";
  if (link.has("play")) play(true);
})();
