// Checks the description of the API, and that each answer is as it says: node check_openapi.js SOCKET NAMES, with NODE_PATH at
// the packages. NAMES is JSON: what stands for `{name}` and `{id}` behind drives, buses, recordings, assets.
"use strict";

const http = require("http");
const { pathToFileURL } = require("url");
const Ajv = require("ajv/dist/2020");
const formats = require("ajv-formats");

const [socketPath, names] = [process.argv[2], JSON.parse(process.argv[3])];

const get = (path) =>
  new Promise((resolve, reject) => {
    const request = http.get({ socketPath, path, headers: { accept: "application/json" } }, (response) => {
      let text = "";
      response.on("data", (piece) => (text += piece));
      response.on("end", () => resolve({ status: response.statusCode, text }));
    });
    request.on("error", reject);
  });

const pointer = (...parts) => parts.map((part) => part.replaceAll("~", "~0").replaceAll("/", "~1")).join("/");

/** Lets no object have a field that is not described. */
function close(schemas) {
  const parts = new Set();
  for (const { allOf = [] } of Object.values(schemas)) for (const { $ref } of allOf) parts.add($ref);
  for (const [name, schema] of Object.entries(schemas)) {
    if (schema.allOf) schema.unevaluatedProperties = false;
    else if (schema.properties && !parts.has(`#/components/schemas/${name}`)) schema.additionalProperties = false;
  }
}

async function main() {
  const { text } = await get("/api/v1/openapi.json");
  const api = JSON.parse(text);
  const { Validator } = await import(pathToFileURL(require.resolve("@seriousme/openapi-schema-validator")));
  const problems = [];
  const described = await new Validator().validate(JSON.parse(text));
  if (!described.valid) problems.push(["the description", described.errors]);
  close(api.components.schemas);
  const ajv = new Ajv({ strict: false, allErrors: true });
  formats(ajv);
  ajv.addSchema(api, "api");
  const answered = {};
  for (const [path, { get: operation }] of Object.entries(api.paths)) {
    const { content = {} } = operation?.responses["200"] ?? {};
    if (!content["application/json"]) continue;
    const { status, text } = await get(path.replace(/(\w+)\/\{\w+\}/, (_, what) => `${what}/${names[what]}`));
    const described = status < 300 ? "200" : "4XX";
    const schema = pointer("paths", path, "get", "responses", described, "content", "application/json", "schema");
    const validate = ajv.compile({ $ref: `api#/${schema}` });
    if (!validate(JSON.parse(text))) problems.push([path, status, validate.errors, text.slice(0, 500)]);
    answered[path] = status;
  }
  if (problems.length) throw new Error(JSON.stringify(problems, null, 1));
  console.log(JSON.stringify({ answered, described: Object.keys(api.paths) }));
}

main().catch((error) => {
  console.error(error.message ?? error);
  process.exit(1);
});
