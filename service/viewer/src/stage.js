// The picture: light, floor, and a camera that keeps its place beside a body that walks.
import {
  BufferGeometry, CircleGeometry, Color, DirectionalLight, Float32BufferAttribute, Fog, HemisphereLight, LineBasicMaterial,
  LineSegments, Mesh, OrbitControls, PCFShadowMap, PerspectiveCamera, Scene, ShadowMaterial, Vector3, WebGLRenderer,
} from "./three.js";

const MIDDLE = 0.95; // height the camera looks at [m]
const TALL = 2.15, WIDE = 1.5; // what it frames [m]

export class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new WebGLRenderer({ canvas, antialias: true });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = PCFShadowMap;
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(28, 1, 0.05, 80);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { enableDamping: false, minDistance: 0.6, maxDistance: 14, maxPolarAngle: 0.54 * Math.PI });
    this.controls.addEventListener("change", () => this.draw());
    this.root = new Vector3();
    this.light();
    this.floor();
    this.colours();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.colours(); this.draw(); });
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.home();
  }

  light() {
    this.sky = new HemisphereLight(0xffffff, 0x8a8f98);
    this.sun = new DirectionalLight(0xfff6ec);
    this.rim = new DirectionalLight(0xdce8ff);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    this.sun.shadow.normalBias = 0.02;
    this.sun.shadow.radius = 5;
    Object.assign(this.sun.shadow.camera, { left: -1.5, right: 1.5, top: 1.6, bottom: -1.6, near: 0.5, far: 9 });
    this.scene.add(this.sky, this.sun, this.sun.target, this.rim, this.rim.target);
    this.flatten(false);
  }

  /** Flat white light, so that colours that mean numbers look like those of their legend. */
  flatten(on) {
    this.sky.intensity = on ? 2.5 : 1.35;
    this.sky.groundColor.set(on ? 0xd8d8d8 : 0x8a8f98);
    this.sun.intensity = on ? 0.75 : 2.1;
    this.sun.color.set(on ? 0xffffff : 0xfff6ec);
    this.rim.intensity = on ? 0.2 : 0.7;
  }

  floor() {
    this.grid = new LineSegments(grid(12, 0.5), new LineBasicMaterial());
    this.shade = new Mesh(new CircleGeometry(12, 48).rotateX(-Math.PI / 2), new ShadowMaterial({ opacity: 0.22 }));
    this.shade.receiveShadow = true;
    this.shade.position.y = -0.002;
    this.grid.position.y = -0.004;
    this.scene.add(this.grid, this.shade);
  }

  /** Background and floor as the page's style sheet has them, light or dark. */
  colours() {
    const style = getComputedStyle(this.canvas), read = (name) => new Color(style.getPropertyValue(name).trim());
    this.scene.background = read("--stage");
    this.scene.fog = new Fog(this.scene.background, 7, 16);
    this.grid.material.color = read("--grid");
    this.shade.material.opacity = Number(style.getPropertyValue("--shadow"));
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio || 1, 2));
    this.renderer.setSize(width, height, false);
    const before = this.camera.aspect;
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if ((before < WIDE / TALL) !== (this.camera.aspect < WIDE / TALL) || !this.sized) this.home();
    this.sized = true;
    this.draw();
  }

  /** The camera back to where the whole body is seen, a little from the side. */
  home() {
    const half = Math.tan((this.camera.fov * Math.PI) / 360);
    const distance = Math.max(TALL, WIDE / Math.max(this.camera.aspect, 0.1)) / (2 * half);
    this.controls.target.set(this.root.x, MIDDLE, this.root.z);
    this.camera.position.copy(this.controls.target).add(new Vector3(0.48, 0.2, 1).normalize().multiplyScalar(distance));
    this.controls.update();
    this.draw();
  }

  /** Keeps beside the body whose root is at (x, z) on the floor. */
  follow(x, z) {
    const step = new Vector3(x - this.root.x, 0, z - this.root.z);
    this.root.set(x, 0, z);
    this.camera.position.add(step);
    this.controls.target.add(step);
    const place = (object, [right, up, front]) => object.position.set(x + right, up, z + front);
    place(this.sun, [1.6, 4.2, 2.6]);
    place(this.sun.target, [0, 0.9, 0]);
    place(this.rim, [-2.5, 2.2, -2.5]);
    place(this.rim.target, [0, 1, 0]);
    this.grid.position.x = Math.round(2 * x) / 2;
    this.grid.position.z = Math.round(2 * z) / 2;
    this.shade.position.x = x;
    this.shade.position.z = z;
  }

  turn(right, up) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    offset.applyAxisAngle(new Vector3(0, 1, 0), -right);
    const side = new Vector3(0, 1, 0).cross(offset).normalize();
    offset.applyAxisAngle(side, -up);
    if (Math.abs(offset.angleTo(new Vector3(0, 1, 0)) - Math.PI / 2) > 1.45) return;
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.draw();
  }

  zoom(factor) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    this.camera.position.copy(this.controls.target).add(offset.setLength(Math.min(Math.max(offset.length() * factor, 0.6), 14)));
    this.controls.update();
    this.draw();
  }

  /** Paints at the next chance. */
  draw() {
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => { this.pending = 0; this.renderer.render(this.scene, this.camera); });
  }
}

/** A square grid every `step` metres, out to `reach` on each side, in short pieces: long lines are badly clipped. */
function grid(reach, step) {
  const points = [];
  for (let at = -reach; at <= reach; at += step) for (let from = -reach; from < reach; from += step) {
    points.push(at, 0, from, at, 0, from + step, from, 0, at, from + step, 0, at);
  }
  return new BufferGeometry().setAttribute("position", new Float32BufferAttribute(points, 3));
}
