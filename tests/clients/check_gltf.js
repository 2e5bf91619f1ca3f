// Checks that Khronos' glTF validator finds no issue of any severity in any .glb or .gltf.

const fs = require("fs");
const path = require("path");
const validator = require(path.resolve(process.argv[2], "node_modules", "gltf-validator"));

const OUT = process.argv[3];
const SEVERITIES = ["numErrors", "numWarnings", "numInfos", "numHints"];

async function main() {
  console.log(`gltf: gltf-validator ${validator.version()} finds nothing to say`);
  const files = fs
    .readdirSync(OUT, { recursive: true })
    .filter((name) => /\.(glb|gltf)$/.test(name))
    .sort();
  const failed = [];
  for (const name of files) {
    const line = await examined(name);
    console.log(`  ${line.faults.length ? "FAILED" : "ok    "} ${name}: ${line.figures}`);
    line.faults.forEach((fault) => console.log(`         ${fault}`));
    if (line.faults.length) failed.push(name);
  }
  console.log(`  ${files.length - failed.length} passed, ${failed.length} failed`);
  process.exitCode = failed.length || !files.length ? 1 : 0;
}

async function examined(name) {
  try {
    const bytes = new Uint8Array(fs.readFileSync(path.join(OUT, name)));
    // The validator gets no external resources: a file that refers to any is invalid.
    const report = await validator.validateBytes(bytes, { uri: name, maxIssues: 10 });
    const faults = report.issues.messages.map(({ code, message, pointer }) => `${code} ${pointer}: ${message}`);
    if (SEVERITIES.some((severity) => report.issues[severity]) && !faults.length) {
      faults.push(JSON.stringify(report.issues));
    }
    const { totalVertexCount, totalTriangleCount } = report.info;
    return { figures: `${totalVertexCount} vertices, ${totalTriangleCount} triangles`, faults };
  } catch (error) {
    return { figures: "could not be examined", faults: [String(error)] };
  }
}

main();
