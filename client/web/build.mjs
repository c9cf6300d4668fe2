// `node build.mjs [FOLDER]` bundles the pages into FOLDER (default dist); `--tests` bundles the tests into .test, `--library`
// what the npm package offers into lib; `--types` finishes the types that tsc has put there.
// The same sources and the pinned packages give the same bytes on every machine.
import { copyFile, mkdir, readdir, readFile, rm, writeFile } from "node:fs/promises";
import { join } from "node:path";
import { build } from "esbuild";

const argument = process.argv[2] ?? "dist";

/** What needs no building; sample.py makes the sample. */
const COPIED = ["index.html", "manifest.webmanifest", "icon-192.png", "icon-512.png", "sample.probeless"];

async function buildPage(folder) {
  await rm(folder, { recursive: true, force: true });
  await mkdir(folder, { recursive: true });
  await build({
    entryPoints: { app: "src/main.ts", worker: "src/worker.ts", style: "src/style.css" },
    outdir: folder,
    bundle: true,
    splitting: true, // three.js is fetched where it is needed only
    chunkNames: "[name]-[hash]",
    minify: true,
    format: "esm",
    target: "es2022",
    charset: "utf8",
    legalComments: "none",
    logLevel: "warning",
    preserveSymlinks: true, // or the names of chunks depend on where a linked node_modules lies
  });
  for (const name of COPIED) await copyFile(join("src", name), join(folder, name));
  await buildInOne("results", join(folder, "results.html"), ["three"]);
  await buildInOne("place", join(folder, "place.html"), []);
  const licences = await Promise.all(["@msgpack/msgpack", "fzstd", "three"].map((name) => readFile(`node_modules/${name}/LICENSE`, "utf8")));
  await writeFile(join(folder, "LICENSES.txt"), licences.join("\n----\n\n"));
}

/** A page in one file: browsers load no modules for a page that comes from disk. `libraries`: what it contains. */
async function buildInOne(name, file, libraries) {
  const { outputFiles } = await build({
    entryPoints: { script: `src/${name}/main.ts`, style: `src/${name}/style.css` },
    outdir: ".",
    write: false,
    bundle: true,
    minify: true,
    format: "iife",
    target: "es2022",
    charset: "utf8",
    legalComments: "none",
    logLevel: "warning",
  });
  let page = await readFile(`src/${name}/page.html`, "utf8");
  for (const { path, text } of outputFiles) {
    const part = path.endsWith(".css") ? "style" : "script";
    page = page.replace(`/*${part}*/`, () => text.replaceAll("</script", "<\\/script").replaceAll("<!--", "<\\!--"));
  }
  const licences = libraries.map(async (each) => `<!-- Contains ${each}.js:\n\n${(await readFile(`node_modules/${each}/LICENSE`, "utf8")).trim()}\n-->\n`);
  await writeFile(file, page + (await Promise.all(licences)).join(""));
}

async function buildLibrary(folder) {
  await rm(folder, { recursive: true, force: true });
  await build({
    entryPoints: { probeless: "src/library.ts" },
    outdir: folder,
    bundle: true,
    packages: "external",
    format: "esm",
    target: "es2022",
    charset: "utf8",
    logLevel: "warning",
  });
}

/** Node.js wants to be told which file is meant; the page's own sources need not say it. */
async function nameFiles(folder) {
  for (const name of (await readdir(folder)).filter((each) => each.endsWith(".d.ts"))) {
    const text = await readFile(join(folder, name), "utf8");
    await writeFile(join(folder, name), text.replace(/(from "\.\/[\w/]+)"/g, '$1.js"'));
  }
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

if (argument === "--tests") await buildTests(".test");
else if (argument === "--library") await buildLibrary("lib");
else if (argument === "--types") await nameFiles("lib/types");
else await buildPage(argument);
