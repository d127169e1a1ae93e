// The Khronos validator's findings on glTF files, one JSON object a file: node validate_gltf.mjs FILE...
// Needs the npm package gltf-validator (npm install in this folder, or NODE_PATH).
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { basename, dirname, join } from 'node:path';

const require = createRequire(import.meta.url);
const validator = require(require.resolve('gltf-validator', { paths: [process.cwd(), import.meta.dirname, ...(process.env.NODE_PATH ?? '').split(':')] }));

let failed = false;
for (const path of process.argv.slice(2)) {
  const report = await validator.validateBytes(new Uint8Array(readFileSync(path)), {
    uri: basename(path),
    externalResourceFunction: async (uri) => new Uint8Array(readFileSync(join(dirname(path), decodeURIComponent(uri)))),
  });
  const { numErrors, numWarnings, numInfos, messages } = report.issues;
  failed ||= numErrors > 0;
  console.log(JSON.stringify({ file: path, errors: numErrors, warnings: numWarnings, infos: numInfos, messages }));
}
process.exitCode = failed ? 1 : 0;
