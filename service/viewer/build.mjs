// Bundles src/ into static/: three.js as a module of its own, the page's code as another, nothing from elsewhere.
// Run by `make viewer`, which installs package.json's packages into the folder given. Built files begin with a digest
// of the sources, so that a test can tell a stale build.
import { createHash } from "node:crypto";
import { copyFileSync, mkdirSync, readFileSync, readdirSync } from "node:fs";
import { createRequire } from "node:module";
import { resolve } from "node:path";

const here = new URL(".", import.meta.url).pathname, packages = resolve(process.argv[2], "node_modules");
const { buildSync } = createRequire(`${packages}/`)("esbuild");

const digest = createHash("sha256");
for (const name of readdirSync(`${here}src`).sort()) digest.update(readFileSync(`${here}src/${name}`));
digest.update(readFileSync(`${here}../clients/stream.js`));
const banner = { js: `/* built from sources ${digest.digest("hex")} */` };
const bundle = (name, external) => buildSync({
  entryPoints: [`${here}src/${name}`], outfile: `${here}static/${name}`, external, banner, nodePaths: [packages],
  bundle: true, format: "esm", target: "es2022", minify: true, legalComments: "inline",
});

mkdirSync(`${here}static`, { recursive: true });
bundle("three.js", []);
bundle("viewer.js", ["./three.js"]);
for (const name of ["index.html", "style.css"]) copyFileSync(`${here}src/${name}`, `${here}static/${name}`);
copyFileSync(`${packages}/three/LICENSE`, `${here}static/three.LICENSE.txt`);
