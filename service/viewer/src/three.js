// The parts of three.js that the page uses; a module of its own, so that tests load GLB files with the same code.
export {
  AnimationMixer, BufferAttribute, BufferGeometry, CircleGeometry, Color, DirectionalLight, DoubleSide,
  Float32BufferAttribute, Fog, Group, HemisphereLight, LineBasicMaterial, LineSegments, Mesh, MeshStandardMaterial,
  PCFShadowMap, PerspectiveCamera, Quaternion, Scene, ShadowMaterial, Sphere, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
