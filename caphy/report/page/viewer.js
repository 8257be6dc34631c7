// A small WebGL viewer: moving meshes coloured by error. One per .viewer element; nothing is loaded from anywhere.
"use strict";
(() => {
  const colours = JSON.parse(document.getElementById("colours").textContent);
  const SIGNED = { "outward (+) or inward": true, "too low (+) or too high": true };
  const HOLE = -32768;

  const VERTEX = `
    attribute vec3 position; attribute vec3 normal; attribute float error;
    uniform mat4 view; uniform mat4 projection; uniform float pointSize;
    varying vec3 shade; varying float value;
    void main() {
      vec4 eye = view * vec4(position, 1.0);
      shade = mat3(view) * normal; value = error;
      gl_Position = projection * eye; gl_PointSize = pointSize / max(-eye.z, 0.1);
    }`;
  const FRAGMENT = `
    precision mediump float;
    uniform vec3 stops[5]; uniform vec3 unknown; uniform vec4 flat_; uniform float coloured; uniform float lit;
    varying vec3 shade; varying float value;
    void main() {
      vec3 c = unknown;
      if (value > -50.0) {
        float x = clamp(value, 0.0, 1.0) * 4.0;
        c = mix(stops[0], stops[1], clamp(x, 0.0, 1.0));
        c = mix(c, stops[2], clamp(x - 1.0, 0.0, 1.0));
        c = mix(c, stops[3], clamp(x - 2.0, 0.0, 1.0));
        c = mix(c, stops[4], clamp(x - 3.0, 0.0, 1.0));
      }
      c = mix(flat_.rgb, c, coloured);
      vec3 n = normalize(shade + vec3(0.0, 0.0, 1e-6));
      float light = 0.7 + 0.32 * abs(dot(n, normalize(vec3(0.35, 0.55, 0.75))));
      gl_FragColor = vec4(c * mix(1.0, light, lit), flat_.a);
    }`;

  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);

  async function unpack(text, Type) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Type(await new Response(stream).arrayBuffer());
  }

  // 4x4 matrices, column by column.
  function perspective(angle, aspect, near, far) {
    const f = 1 / Math.tan(angle / 2), d = 1 / (near - far);
    return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) * d, -1, 0, 0, 2 * near * far * d, 0];
  }
  function orbit(camera) {
    const { azimuth: a, elevation: e, distance: d, target: t } = camera;
    const z = [Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e)];
    const x = [Math.cos(a), 0, -Math.sin(a)];
    const y = [z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]];
    const eye = t.map((v, i) => v + d * z[i]);
    const dot = (p, q) => p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
    return [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1];
  }
  function multiply(a, b) {
    const out = new Array(16).fill(0);
    for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
    return out;
  }

  function normals(positions, faces, out) {
    out.fill(0);
    for (let f = 0; f < faces.length; f += 3) {
      const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
      const ux = positions[b] - positions[a], uy = positions[b + 1] - positions[a + 1], uz = positions[b + 2] - positions[a + 2];
      const vx = positions[c] - positions[a], vy = positions[c + 1] - positions[a + 1], vz = positions[c + 2] - positions[a + 2];
      const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
      if (nx !== nx) continue;
      for (const i of [a, b, c]) { out[i] += nx; out[i + 1] += ny; out[i + 2] += nz; }
    }
    return out;
  }

  function edges(faces) {
    const seen = new Set(), out = [];
    for (let f = 0; f < faces.length; f += 3) for (let k = 0; k < 3; k++) {
      const a = faces[f + k], b = faces[f + (k + 1) % 3], key = a < b ? a * 4294967296 + b : b * 4294967296 + a;
      if (!seen.has(key)) { seen.add(key); out.push(a, b); }
    }
    return new Uint32Array(out);
  }

  class Viewer {
    constructor(root) {
      this.root = root;
      this.find = (name) => root.querySelector("." + name);
      this.canvas = root.querySelector("canvas");
      this.row = 0; this.playing = false; this.scale = parseFloat(root.dataset.scale);
    }

    async start() {
      if (this.started) return;
      this.started = true;
      try { await this.load(); } catch (error) {
        const message = this.find("message");
        message.hidden = false;
        message.textContent = "The 3D view cannot be shown here: " + error.message;
        return;
      }
      this.listen(); this.home(); this.show(0);
    }

    async load() {
      if (typeof DecompressionStream === "undefined") throw new Error("this browser is too old to unpack it.");
      const gl = this.gl = this.canvas.getContext("webgl", { antialias: true, alpha: true });
      if (!gl) throw new Error("WebGL is switched off.");
      if (!gl.getExtension("OES_element_index_uint")) throw new Error("WebGL lacks large meshes.");
      const s = this.scene = JSON.parse(this.find("scene").textContent);
      this.find("scene").remove();
      [this.faces, this.model, this.regions] = await Promise.all([unpack(s.faces, Uint32Array), unpack(s.model, Uint16Array), unpack(s.regions, Uint16Array)]);
      this.fields = {};
      for (const name of Object.keys(s.fields)) this.fields[name] = await unpack(s.fields[name], Int16Array);
      if (s.measured) this.measured = await unpack(s.measured, Uint16Array);
      if (s.body) { this.body = await unpack(s.body, Uint16Array); this.bodyFaces = await unpack(s.bodyFaces, Uint32Array); }
      this.program = this.compile();
      const select = this.find("field");
      for (const name of Object.keys(this.fields)) select.add(new Option(name, name));
      this.find("scrub").max = s.rows - 1;
      this.find("scale").value = this.scale;
      this.find("body-option").hidden = !this.body;
      this.find("show-measured").closest("label").hidden = !this.measured;
      this.buffers = { model: this.mesh(this.faces), measured: this.mesh(this.faces), body: this.mesh(this.bodyFaces) };
    }

    compile() {
      const gl = this.gl, program = gl.createProgram();
      for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
        const shader = gl.createShader(type);
        gl.shaderSource(shader, source); gl.compileShader(shader);
        if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
        gl.attachShader(program, shader);
      }
      gl.linkProgram(program); gl.useProgram(program);
      gl.enable(gl.DEPTH_TEST);
      this.at = (name) => gl.getUniformLocation(program, name);
      return program;
    }

    mesh(faces) {
      const gl = this.gl, made = { position: gl.createBuffer(), normal: gl.createBuffer(), error: gl.createBuffer(), count: 0 };
      if (faces) {
        made.index = gl.createBuffer(); made.indexCount = faces.length;
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made.index);
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
        const wire = edges(faces);
        made.wire = gl.createBuffer(); made.wireCount = wire.length;
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made.wire);
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, wire, gl.STATIC_DRAW);
      }
      return made;
    }

    // Positions of points first..last of a packed array; holes become NaN.
    positions(packed, first, last) {
      const { low, scale } = this.scene, out = new Float32Array(3 * (last - first));
      for (let i = 0; i < out.length; i++) {
        const q = packed[3 * first + i];
        out[i] = q === 65535 ? NaN : low[i % 3] + scale * q;
      }
      return out;
    }

    fill(mesh, positions, faces, errors) {
      const gl = this.gl;
      mesh.count = positions.length / 3;
      const up = (buffer, data) => { gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW); };
      up(mesh.normal, faces ? normals(positions, faces, new Float32Array(positions.length)) : new Float32Array(positions.length));
      up(mesh.position, positions);
      up(mesh.error, errors || new Float32Array(mesh.count));
    }

    errors() {
      const { vertexCount: n, stepMm } = this.scene, name = this.find("field").value, packed = this.fields[name];
      this.millimetres = new Float32Array(n); const shown = new Float32Array(n);
      for (let i = 0; i < n; i++) {
        const q = packed[this.row * n + i];
        this.millimetres[i] = q === HOLE ? NaN : q * stepMm;
        shown[i] = q === HOLE ? -100 : SIGNED[name] ? 0.5 + 0.5 * Math.max(-1, Math.min(1, q * stepMm / this.scale)) : q * stepMm / this.scale;
      }
      return shown;
    }

    show(row) {
      const s = this.scene, n = s.vertexCount;
      this.row = Math.max(0, Math.min(s.rows - 1, row));
      this.current = this.positions(this.model, this.row * n, (this.row + 1) * n);
      this.fill(this.buffers.model, this.current, this.faces, this.errors());
      if (this.measured) {
        const [a, b] = [s.measuredOffsets[this.row], s.measuredOffsets[this.row + 1]];
        this.fill(this.buffers.measured, this.positions(this.measured, a, b), s.measuredMesh ? this.faces : null);
      }
      if (this.body) {
        const body = this.positions(this.body, this.row * s.bodyCount, (this.row + 1) * s.bodyCount);
        this.fill(this.buffers.body, body, this.bodyFaces); this.follow(body);
      }
      const frame = s.frames[this.row];
      this.find("scrub").value = this.row;
      const number = s.numbering[0] + s.numbering[1] * frame; // as the source has it, and the sentences
      this.find("clock").textContent = `frame ${number} · ${(frame / s.fps).toFixed(2)} s`;
      this.find("scrub").setAttribute("aria-valuetext", `frame ${number}`);
      this.onframe?.(frame);
      this.draw();
    }

    // The camera keeps its place beside a body that walks.
    follow(body) {
      const mean = [0, 0, 0];
      for (let i = 0; i < body.length; i++) mean[i % 3] += body[i] * 3 / body.length;
      const before = this.followed || this.firstMean || mean;
      this.firstMean ||= mean;
      for (let i = 0; i < 3; i++) this.camera.target[i] += mean[i] - before[i];
      this.followed = mean;
    }

    jump(frame) {
      const frames = this.scene.frames;
      let best = 0;
      frames.forEach((f, i) => { if (Math.abs(f - frame) < Math.abs(frames[best] - frame)) best = i; });
      this.show(best);
    }

    home() {
      const { centre, distance, azimuth, elevation } = this.scene.focus;
      const narrow = Math.min(1, this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1));
      this.camera = { azimuth, elevation, distance: distance / narrow, target: [...centre] };
      this.followed = null;
      this.legend();
    }

    legend() {
      const signed = SIGNED[this.find("field").value], stops = signed ? colours.diverging : colours.sequential;
      this.find("ramp").style.background = `linear-gradient(90deg, ${stops.join(",")})`;
      this.find("low").textContent = signed ? `−${this.scale}` : "0";
      this.find("high").textContent = `${signed ? "+" : ""}${this.scale} mm`;
    }

    draw() {
      if (this.pending) return;
      this.pending = requestAnimationFrame(() => { this.pending = 0; this.paint(); });
    }

    paint() {
      const gl = this.gl, canvas = this.canvas, ratio = Math.min(window.devicePixelRatio || 1, 2);
      const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
      if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
      gl.viewport(0, 0, width, height);
      gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      const view = orbit(this.camera), projection = perspective(this.scene.focus.field, width / Math.max(height, 1), 0.02, 60);
      this.matrix = multiply(projection, view);
      gl.uniformMatrix4fv(this.at("view"), false, view); gl.uniformMatrix4fv(this.at("projection"), false, projection);
      const stops = SIGNED[this.find("field").value] ? colours.diverging : colours.sequential;
      const style = getComputedStyle(canvas); // light on a dark page
      gl.uniform3fv(this.at("stops"), stops.flatMap(rgb)); gl.uniform3fv(this.at("unknown"), rgb(colours.unknown));
      gl.uniform1f(this.at("pointSize"), 3.2 * ratio * Math.max(1, height / 500));
      const shows = (name) => this.find("show-" + name).checked;
      if (this.body && shows("body")) this.drawMesh(this.buffers.body, [0.78, 0.72, 0.68, 1], 0, gl.TRIANGLES);
      if (shows("model")) this.drawMesh(this.buffers.model, [1, 1, 1, 1], 1, gl.TRIANGLES);
      if (this.measured && shows("measured")) {
        const alone = !shows("model") && this.scene.measuredMesh;
        if (alone) this.drawMesh(this.buffers.measured, [0.45, 0.58, 0.72, 1], 0, gl.TRIANGLES);
        else this.drawMesh(this.buffers.measured, [...rgb(style.getPropertyValue("--measured").trim()), 1], 0, this.scene.measuredMesh ? gl.LINES : gl.POINTS);
      }
    }

    drawMesh(mesh, flat, coloured, mode) {
      const gl = this.gl;
      for (const [name, size] of [["position", 3], ["normal", 3], ["error", 1]]) {
        const place = gl.getAttribLocation(this.program, name);
        gl.bindBuffer(gl.ARRAY_BUFFER, mesh[name]); gl.enableVertexAttribArray(place);
        gl.vertexAttribPointer(place, size, gl.FLOAT, false, 0, 0);
      }
      gl.uniform4fv(this.at("flat_"), flat); gl.uniform1f(this.at("coloured"), coloured);
      gl.uniform1f(this.at("lit"), mode === gl.TRIANGLES ? 1 : 0);
      if (mode === gl.POINTS) gl.drawArrays(gl.POINTS, 0, mesh.count);
      else if (mode === gl.LINES) { gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.wire); gl.drawElements(gl.LINES, mesh.wireCount, gl.UNSIGNED_INT, 0); }
      else { gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.index); gl.drawElements(gl.TRIANGLES, mesh.indexCount, gl.UNSIGNED_INT, 0); }
    }

    probe(event) {
      const box = this.canvas.getBoundingClientRect(), label = this.find("probe");
      const x = event.clientX - box.left, y = event.clientY - box.top, m = this.matrix;
      let best = -1, nearest = 18 * 18, depth = Infinity;
      for (let i = 0; m && i < this.scene.vertexCount; i++) {
        const [px, py, pz] = this.current.subarray(3 * i, 3 * i + 3);
        const w = m[3] * px + m[7] * py + m[11] * pz + m[15];
        const sx = (0.5 + 0.5 * (m[0] * px + m[4] * py + m[8] * pz + m[12]) / w) * box.width;
        const sy = (0.5 - 0.5 * (m[1] * px + m[5] * py + m[9] * pz + m[13]) / w) * box.height;
        const d = (sx - x) ** 2 + (sy - y) ** 2;
        if (d < nearest && (d < 64 ? w < depth : true)) { best = i; nearest = Math.max(d, 64); depth = w; }
      }
      label.hidden = best < 0;
      if (best < 0) return;
      const error = this.millimetres[best], region = this.scene.regionNames[this.regions[best]].replaceAll("_", " ");
      label.textContent = (isNaN(error) ? "not measured" : `${error.toFixed(1)} mm`) + (region ? ` · ${region}` : "");
      label.style.left = Math.min(x + 14, box.width - label.offsetWidth - 6) + "px"; label.style.top = Math.max(y - 34, 4) + "px";
    }

    play(on) {
      this.playing = on;
      const button = this.find("play");
      button.textContent = on ? "Pause" : "Play"; button.setAttribute("aria-pressed", on);
      if (!on) return;
      let last = performance.now();
      const stride = this.scene.rows > 1 ? (this.scene.frames.at(-1) - this.scene.frames[0]) / (this.scene.rows - 1) : 1;
      const tick = (now) => {
        if (!this.playing) return;
        const rows = Math.floor((now - last) * this.scene.fps / stride / 1000);
        if (rows > 0) { last += rows * stride * 1000 / this.scene.fps; this.show((this.row + rows) % this.scene.rows); }
        requestAnimationFrame(tick);
      };
      requestAnimationFrame(tick);
    }

    turn(dx, dy) {
      this.camera.azimuth -= dx; this.camera.elevation = Math.max(-1.5, Math.min(1.5, this.camera.elevation + dy));
      this.draw();
    }
    zoom(factor) { this.camera.distance = Math.max(0.1, Math.min(30, this.camera.distance * factor)); this.draw(); }
    pan(dx, dy) {
      const view = orbit(this.camera), size = 2 * Math.tan(this.scene.focus.field / 2) * this.camera.distance / this.canvas.clientHeight;
      for (let i = 0; i < 3; i++) this.camera.target[i] += size * (-dx * view[4 * i] + dy * view[4 * i + 1]);
      this.draw();
    }

    listen() {
      const canvas = this.canvas, pointers = new Map();
      canvas.addEventListener("pointerdown", (e) => { pointers.set(e.pointerId, [e.clientX, e.clientY]); canvas.setPointerCapture(e.pointerId); });
      for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => pointers.delete(e.pointerId));
      canvas.addEventListener("pointerleave", () => { this.find("probe").hidden = true; });
      canvas.addEventListener("pointermove", (e) => {
        const before = pointers.get(e.pointerId);
        if (!before) { this.probe(e); return; }
        const dx = e.clientX - before[0], dy = e.clientY - before[1];
        const others = [...pointers].filter(([id]) => id !== e.pointerId).map(([, place]) => place);
        pointers.set(e.pointerId, [e.clientX, e.clientY]);
        if (others.length) {
          const gap = (p) => Math.hypot(p[0] - others[0][0], p[1] - others[0][1]) || 1;
          this.zoom(gap(before) / gap([e.clientX, e.clientY])); this.pan(dx / 2, dy / 2);
        } else if (e.shiftKey || e.button === 2 || e.buttons === 2) this.pan(dx, dy);
        else this.turn(dx * 0.008, dy * 0.008);
      });
      canvas.addEventListener("contextmenu", (e) => e.preventDefault());
      canvas.addEventListener("wheel", (e) => {
        if (document.activeElement !== canvas && !e.ctrlKey) return; // the page scrolls until the view is chosen
        e.preventDefault(); this.zoom(Math.exp(e.deltaY * 0.0012));
      }, { passive: false });
      const keys = {
        ArrowLeft: () => this.turn(0.12, 0), ArrowRight: () => this.turn(-0.12, 0), ArrowUp: () => this.turn(0, 0.08), ArrowDown: () => this.turn(0, -0.08),
        "+": () => this.zoom(0.9), "=": () => this.zoom(0.9), "-": () => this.zoom(1.1), " ": () => this.play(!this.playing),
        ",": () => this.show(this.row - 1), ".": () => this.show(this.row + 1), Home: () => this.show(0), End: () => this.show(this.scene.rows - 1),
      };
      canvas.addEventListener("keydown", (e) => { if (keys[e.key] && !e.ctrlKey && !e.metaKey) { e.preventDefault(); keys[e.key](); } });
      this.find("play").addEventListener("click", () => this.play(!this.playing));
      this.find("scrub").addEventListener("input", (e) => { this.play(false); this.show(+e.target.value); });
      this.find("home").addEventListener("click", () => { this.home(); this.show(this.row); });
      this.find("field").addEventListener("change", () => { this.legend(); this.show(this.row); });
      this.find("scale").addEventListener("input", (e) => { if (+e.target.value > 0) { this.scale = +e.target.value; this.legend(); this.show(this.row); } });
      for (const name of ["model", "measured", "body"]) this.find("show-" + name).addEventListener("change", () => this.draw());
      new ResizeObserver(() => this.draw()).observe(canvas);
    }
  }

  for (const section of document.querySelectorAll(".comparison")) {
    const root = section.querySelector(".viewer"), plot = section.querySelector(".time svg"), cursor = plot.querySelector(".cursor");
    if (!root) { cursor.remove(); continue; }
    const viewer = new Viewer(root), { first, last, left, right } = plot.dataset;
    viewer.onframe = (frame) => {
      const x = +left + (frame - first) / (last - first) * (right - left);
      cursor.setAttribute("x1", x); cursor.setAttribute("x2", x);
    };
    plot.addEventListener("click", (e) => {
      const box = plot.getBoundingClientRect(), x = (e.clientX - box.left) / box.width * plot.viewBox.baseVal.width;
      viewer.play(false); viewer.jump(+first + (x - left) / (right - left) * (last - first));
    });
    for (const button of section.querySelectorAll(".moments button")) button.addEventListener("click", () => {
      viewer.play(false); viewer.jump(+button.dataset.frame); root.scrollIntoView({ block: "center" });
    });
    new IntersectionObserver((seen) => { if (seen.some((s) => s.isIntersecting)) viewer.start(); }, { rootMargin: "200px" }).observe(root);
  }
})();
