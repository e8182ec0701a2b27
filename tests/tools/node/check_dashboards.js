// Checks Grafana dashboards against the types that Grafana publishes: node check_dashboards.js FILE..., with NODE_PATH at the packages.
"use strict";

const fs = require("fs");
const path = require("path");
const ts = require("typescript");

const TYPES = "@grafana/schema/dist/esm/raw";
const PANELS = {
  stat: "stat/panelcfg/x/StatPanelCfg_types.gen",
  "state-timeline": "statetimeline/panelcfg/x/StateTimelinePanelCfg_types.gen",
  table: "table/panelcfg/x/TablePanelCfg_types.gen",
  timeseries: "timeseries/panelcfg/x/TimeSeriesPanelCfg_types.gen",
};
// What a panel of this type may have per field; a stat has nothing of its own.
const WITH_FIELDS = ["state-timeline", "table", "timeseries"];

// What Grafana's Prometheus data source adds to an annotation, and the editor to a variable.
const ANNOTATION = ["expr", "step", "textFormat", "titleFormat"];
const VARIABLE = ["definition"];

const without = (object, keys) => Object.fromEntries(Object.entries(object).filter(([key]) => !keys.includes(key)));

/** The dashboard as TypeScript, each part against the type that Grafana gives it. */
function source(dashboard) {
  const lines = [
    `import type { Dashboard, Panel, RowPanel } from "${TYPES}/dashboard/x/dashboard_types.gen";`,
    ...Object.entries(PANELS).map(([type, file], i) => `import type * as P${i} from "${TYPES}/composable/${file}";`),
    // In JSON an enumeration is its value.
    "type Json<T> = unknown extends T ? unknown : T extends string ? `${T}` : T extends number | boolean | null | undefined ? T",
    "  : T extends (infer U)[] ? Json<U>[] : T extends object ? { [K in keyof T]: Json<T[K]> } : T;",
  ];
  const check = (type, value) => lines.push(`const v${lines.length}: ${type} = ${JSON.stringify(value)};`);
  check("Json<Dashboard>", {
    ...without(dashboard, ["panels"]),
    annotations: { list: dashboard.annotations.list.map((one) => without(one, ANNOTATION)) },
    templating: { list: dashboard.templating.list.map((one) => without(one, VARIABLE)) },
  });
  for (const panel of dashboard.panels) {
    if (panel.type === "row") {
      check("Json<RowPanel>", panel);
      continue;
    }
    const number = Object.keys(PANELS).indexOf(panel.type);
    if (number < 0) throw new Error(`panel ${panel.title}: no types for ${panel.type}`);
    const { custom, ...defaults } = panel.fieldConfig.defaults;
    check("Json<Panel>", { ...without(panel, ["targets"]), fieldConfig: { ...panel.fieldConfig, defaults } });
    check(`Json<Partial<P${number}.Options>>`, panel.options);
    if (custom) check(WITH_FIELDS.includes(panel.type) ? `Json<Partial<P${number}.FieldConfig>>` : "never", custom);
  }
  return lines.join("\n");
}

/** What the compiler says of a text. */
function complaints(text) {
  // Beside the packages, so that the imports are found.
  const name = path.join(path.dirname(require.resolve("typescript/package.json")), "../../dashboard.ts");
  const options = { strict: true, noEmit: true, skipLibCheck: true, target: ts.ScriptTarget.ES2022,
    module: ts.ModuleKind.ESNext, moduleResolution: ts.ModuleResolutionKind.Node10 };
  const host = ts.createCompilerHost(options);
  const read = host.getSourceFile.bind(host);
  host.getSourceFile = (file, ...rest) => (file === name ? ts.createSourceFile(file, text, rest[0]) : read(file, ...rest));
  const exists = host.fileExists.bind(host);
  host.fileExists = (file) => file === name || exists(file);
  const found = ts.getPreEmitDiagnostics(ts.createProgram([name], options, host));
  return found.map((one) => {
    const line = one.file && one.start !== undefined ? text.slice(text.lastIndexOf("\n", one.start) + 1).split("\n", 1)[0] : "";
    return `${ts.flattenDiagnosticMessageText(one.messageText, "\n  ")}\n  in ${line.slice(0, 200)}`;
  });
}

let failed = false;
for (const file of process.argv.slice(2)) {
  for (const complaint of complaints(source(JSON.parse(fs.readFileSync(file, "utf8"))))) {
    failed = true;
    console.error(`${file}: ${complaint}`);
  }
}
process.exit(failed ? 1 : 0);
