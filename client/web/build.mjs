// `node build.mjs [FOLDER]` bundles the page into FOLDER (default dist); `--tests` bundles the tests into .test.
// The same sources and the pinned packages give the same bytes on every machine.
import { copyFile, mkdir, readdir, rm } from "node:fs/promises";
import { join } from "node:path";
import { build } from "esbuild";

const argument = process.argv[2] ?? "dist";

async function buildPage(folder) {
  await rm(folder, { recursive: true, force: true });
  await mkdir(folder, { recursive: true });
  await build({
    entryPoints: { app: "src/main.ts", style: "src/style.css" },
    outdir: folder,
    bundle: true,
    minify: true,
    format: "esm",
    target: "es2022",
    charset: "utf8",
    legalComments: "none",
    logLevel: "warning",
  });
  await copyFile("src/index.html", join(folder, "index.html"));
  await copyFile("node_modules/@msgpack/msgpack/LICENSE", join(folder, "app.js.LICENSE.txt"));
}

async function buildTests(folder) {
  await rm(folder, { recursive: true, force: true });
  const names = (await readdir("test")).filter((name) => name.endsWith(".test.ts"));
  await build({
    entryPoints: names.map((name) => join("test", name)),
    outdir: folder,
    outExtension: { ".js": ".mjs" },
    bundle: true,
    platform: "node",
    format: "esm",
    target: "node22",
    logLevel: "warning",
  });
}

await (argument === "--tests" ? buildTests(".test") : buildPage(argument));
