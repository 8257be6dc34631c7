// The avatar as three.js objects: a body skinned on the graphics card, garments whose vertices come from the service.
import {
  BufferAttribute, BufferGeometry, DoubleSide, Group, LineBasicMaterial, LineSegments, Mesh, MeshStandardMaterial,
  GLTFLoader, Quaternion, Sphere, Vector3,
} from "./three.js";
import { JOINTS } from "./wire.js";
import { BodySurface, MOST as DEEPEST } from "./penetration.js";
import { rampColour } from "./ramp.js";
import { largestStretch, MOST, restInverse } from "./strain.js";

const EVERYWHERE = new Sphere(new Vector3(), Infinity); // vertices move; never culled

export class AvatarModel {
  constructor(gltf) {
    this.root = new Group();
    this.root.add(gltf.scene);
    this.garments = new Map();
    const skinned = [];
    gltf.scene.traverse((node) => { if (node.isSkinnedMesh) skinned.push(node); });
    this.body = skinned.find((mesh) => mesh.name === "body");
    this.bones = this.body.skeleton.bones;
    this.rest = this.bones[0].position.clone();
    this.body.castShadow = this.body.receiveShadow = true;
    this.body.frustumCulled = false;
    this.body.material.polygonOffset = true; // cloth that touches skin is seen in front of it
    this.body.material.polygonOffsetFactor = 1.5;
    this.body.material.polygonOffsetUnits = 6;
    for (const mesh of skinned.filter((other) => other !== this.body)) {
      mesh.removeFromParent();
      const garment = new Garment(mesh);
      this.garments.set(mesh.name, garment);
      this.root.add(garment.mesh, garment.wire);
    }
  }

  /** Draws the body so that cloth inside it can be seen, or solid. */
  seeThrough(on) {
    Object.assign(this.body.material, { transparent: on, opacity: on ? 0.35 : 1, depthWrite: !on });
    this.body.castShadow = !on;
    this.body.material.needsUpdate = true;
  }

  /** Draws the garments where their vertices now are; the body must have been posed. */
  update() {
    const worn = [...this.garments.values()].filter((garment) => garment.mesh.visible);
    if (worn.some((garment) => garment.heatKind === "depth")) (this.surface ??= new BodySurface(this.body)).place();
    for (const garment of worn) garment.update(this.surface);
  }

  static async load(glb) { return new AvatarModel(await new GLTFLoader().parseAsync(glb, "")); }

  /** Turns and moves the body: axis-angles (55 * 3) and translations of two frames, mixed. */
  pose(poses, place, otherPoses, otherPlace, share) {
    for (let joint = 0; joint < JOINTS; joint++) {
      turn(poses, joint, this.bones[joint].quaternion);
      if (share) this.bones[joint].quaternion.slerp(turn(otherPoses, joint, between), share);
    }
    const at = (k) => place[k] + share * (otherPlace[k] - place[k]);
    this.bones[0].position.set(this.rest.x + at(0), this.rest.y + at(1), this.rest.z + at(2));
  }
}

const between = new Quaternion(), axis = new Vector3();

function turn(poses, joint, quaternion) {
  axis.fromArray(poses, 3 * joint);
  const angle = axis.length();
  return angle > 1e-9 ? quaternion.setFromAxisAngle(axis.divideScalar(angle), angle) : quaternion.identity();
}

/** One garment. Its faces do not share corners on the graphics card, so that each can have a colour of its own. */
class Garment {
  constructor(skinned) {
    const source = skinned.geometry, corners = source.index.array.length;
    this.name = skinned.name;
    this.faces = source.index.array;
    this.vertices = Float32Array.from(source.attributes.position.array);
    this.normals = new Float32Array(this.vertices.length);
    this.inverse = restInverse(this.vertices, this.faces);
    this.stretch = new Float32Array(this.faces.length / 3);
    this.depth = new Float32Array(this.vertices.length / 3);
    this.geometry = new BufferGeometry();
    for (const name of ["position", "normal", "color"]) this.geometry.setAttribute(name, new BufferAttribute(new Float32Array(3 * corners), 3));
    this.geometry.boundingSphere = EVERYWHERE;
    const { color } = skinned.material;
    this.plain = new MeshStandardMaterial({ color, roughness: 0.88, side: DoubleSide });
    this.heat = new MeshStandardMaterial({ vertexColors: true, roughness: 1, side: DoubleSide });
    this.mesh = new Mesh(this.geometry, this.plain);
    this.mesh.castShadow = this.mesh.receiveShadow = true;
    this.wire = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ transparent: true, opacity: 0.55 }));
    this.wire.geometry.setAttribute("position", new BufferAttribute(this.vertices, 3));
    this.wire.geometry.setIndex(edges(this.faces));
    this.wire.geometry.boundingSphere = EVERYWHERE;
    for (const material of [this.plain, this.heat]) Object.assign(material, { polygonOffset: true, polygonOffsetFactor: 0.5, polygonOffsetUnits: 1 });
    this.show({ visible: true, wire: false, heat: "" });
  }

  /** `heat`: "strain", "depth" or nothing. */
  show({ visible, wire, heat }) {
    this.heatKind = heat;
    this.mesh.visible = visible;
    this.wire.visible = visible && wire;
    this.mesh.material = heat ? this.heat : this.plain;
  }

  /** Draws what `vertices` now holds, on a body whose `surface` is needed for depths only. */
  update(surface) {
    vertexNormals(this.vertices, this.faces, this.normals);
    const { position, normal, color } = this.geometry.attributes;
    for (let corner = 0; corner < this.faces.length; corner++) {
      const from = 3 * this.faces[corner], to = 3 * corner;
      for (let k = 0; k < 3; k++) {
        position.array[to + k] = this.vertices[from + k];
        normal.array[to + k] = this.normals[from + k];
      }
    }
    position.needsUpdate = normal.needsUpdate = true;
    if (this.heatKind) this.paint(surface);
    if (this.wire.visible) this.wire.geometry.attributes.position.needsUpdate = true;
  }

  /** Colours every corner by the stretch of its face, or by its own depth. */
  paint(surface) {
    const { color } = this.geometry.attributes;
    if (this.heatKind === "strain") largestStretch(this.vertices, this.faces, this.inverse, this.stretch);
    else surface.depths(this.vertices, this.depth);
    for (let corner = 0; corner < this.faces.length; corner++) {
      const share = this.heatKind === "strain" ? this.stretch[(corner / 3) | 0] / MOST : this.depth[this.faces[corner]] / DEEPEST;
      rampColour(share, color.array, 3 * corner);
    }
    color.needsUpdate = true;
  }
}

function vertexNormals(vertices, faces, out) {
  out.fill(0);
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    const ux = vertices[b] - vertices[a], uy = vertices[b + 1] - vertices[a + 1], uz = vertices[b + 2] - vertices[a + 2];
    const vx = vertices[c] - vertices[a], vy = vertices[c + 1] - vertices[a + 1], vz = vertices[c + 2] - vertices[a + 2];
    const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
    out[a] += nx; out[a + 1] += ny; out[a + 2] += nz;
    out[b] += nx; out[b + 1] += ny; out[b + 2] += nz;
    out[c] += nx; out[c + 1] += ny; out[c + 2] += nz;
  }
  for (let i = 0; i < out.length; i += 3) {
    const length = Math.hypot(out[i], out[i + 1], out[i + 2]) || 1;
    out[i] /= length; out[i + 1] /= length; out[i + 2] /= length;
  }
}

function edges(faces) {
  const seen = new Set(), found = [];
  for (let f = 0; f < faces.length; f += 3) for (let k = 0; k < 3; k++) {
    const a = faces[f + k], b = faces[f + (k + 1) % 3], key = a < b ? a * 2 ** 26 + b : b * 2 ** 26 + a;
    if (!seen.has(key)) { seen.add(key); found.push(a, b); }
  }
  return found;
}
