// Bundles src/main.js and three.js into the one script that the report carries. Run: npm ci && npm run build
import { createHash } from "node:crypto";
import { readFileSync, readdirSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const licence = readFileSync("node_modules/three/LICENSE", "utf8").trim();
const sources = ["build.mjs", "package-lock.json", ...readdirSync("src").sort().map((name) => `src/${name}`)];
const digest = createHash("sha256").update(sources.map((name) => readFileSync(name, "utf8")).join("")).digest("hex"); // checked by a test
const out = "../ssmpipe/report/assets/viewer.js";
await build({
  entryPoints: ["src/main.js"],
  bundle: true,
  minify: true,
  charset: "ascii",
  format: "iife",
  target: "es2020",
  legalComments: "none",
  banner: { js: `/*! ssmpipe viewer, built from viewer/ (sources ${digest})\nContains three.js, used under its licence:\n\n${licence}\n*/` },
  outfile: out,
});
const text = readFileSync(out, "utf8").replace(/\r\n/g, "\n");
if (/<\/script|<!--/i.test(text)) throw new Error("the bundle would end its own script element");
writeFileSync(out, text);
console.log(`${out}: ${Math.round(text.length / 1024)} KB`);
