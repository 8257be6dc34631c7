// The parts of three.js that the page uses; a module of its own, so that tests load GLB files with the same code.
export {
  AmbientLight, AnimationMixer, BufferAttribute, BufferGeometry, CircleGeometry, Color, DirectionalLight, DoubleSide,
  Fog, GridHelper, Group, HemisphereLight, LineBasicMaterial, LineSegments, Mesh, MeshStandardMaterial, PCFShadowMap,
  PerspectiveCamera, Quaternion, Scene, ShadowMaterial, Sphere, SRGBColorSpace, Timer, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
