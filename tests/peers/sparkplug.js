// Sparkplug B as Eclipse Tahu's own decoder sees it; NODE_PATH at the packages.
//   sparkplug.js check < LINES   lines `retain|qos|topic|payload in hex`, as a subscriber got them: decodes each message, checks
//                                the rules of the specification for edge nodes, prints both as JSON
//   sparkplug.js encode JSON     a payload in hex: {"timestamp": ms, "metrics": [{"name", "type", "value"}]}
"use strict";
const fs = require("fs");
const sparkplug = require("sparkplug-payload").get("spBv1.0");

const QUALITIES = [0, 192, 500];
const number = (value) => (value === undefined || value === null ? value : Number(value));

class Checker {
  constructor() {
    this.checked = {};
    this.failed = [];
    this.messages = [];
    this.nodes = {};
  }

  // One message and the rules (`tck-id-…`) that it has to keep.
  rule(holds, at, ...ids) {
    for (const id of ids) {
      this.checked[id] = (this.checked[id] || 0) + 1;
      if (!holds) this.failed.push(`tck-id-${id}: ${at}`);
    }
  }

  message(line, index) {
    const [retain, qos, topic, hex] = line.split("|");
    const levels = topic.split("/");
    const [namespace, group, type, node, device] = levels;
    if (group === "STATE" || type === "NCMD" || type === "DCMD") return;
    const at = `message ${index}, ${topic}`;
    this.rule(namespace === "spBv1.0", at, "topic-structure-namespace-a");
    const known = { NBIRTH: 4, NDATA: 4, NDEATH: 4, DBIRTH: 5, DDATA: 5, DDEATH: 5 }[type];
    const lower = String(type).toLowerCase();
    this.rule(known === levels.length && levels.every((level) => level !== ""), at, `topics-${lower}-topic`);
    let payload;
    try {
      payload = sparkplug.decodePayload(Buffer.from(hex, "hex"));
    } catch (error) {
      this.rule(false, `${at}: ${error}`, "payloads-sequence-num-always-included");
      return;
    }
    const decoded = {
      topic, type, device, seq: number(payload.seq), timestamp: number(payload.timestamp), retain: retain === "1",
      qos: Number(qos), metrics: payload.metrics || [],
    };
    this.envelope(decoded, lower, at);
    const state = (this.nodes[`${group}/${node}`] ||= { ever: {}, bdSeqs: [] });
    if (type === "NDEATH") this.nodeDeath(state, decoded, at);
    else this.session(state, decoded, lower, at);
    this.messages.push({
      type, device, seq: decoded.seq, qos: decoded.qos, timestamp: decoded.timestamp,
      metrics: decoded.metrics.map((metric) => this.show(state, metric)),
    });
  }

  show(state, metric) {
    const properties = {};
    for (const [key, property] of Object.entries(metric.properties || {})) properties[key] = property.value;
    const alias = number(metric.alias);
    const known = state.aliases && state.aliases[alias];
    const value = metric.value && typeof metric.value === "object" ? Number(metric.value) : metric.value;
    return {
      name: metric.name || (known && known.name), alias, value, type: metric.type, properties,
      timestamp: number(metric.timestamp), historical: metric.isHistorical === true,
    };
  }

  envelope(message, lower, at) {
    const { qos, retain, seq, type } = message;
    if (type === "NDEATH") {
      const ids = ["payloads-ndeath-will-message-qos", "message-flow-edge-node-birth-publish-will-message-qos"];
      this.rule(qos === 1, at, ...ids);
      const kept = ["payloads-ndeath-will-message-retain", "message-flow-edge-node-birth-publish-will-message-will-retained"];
      this.rule(!retain, at, ...kept);
      this.rule(seq === undefined, at, "payloads-ndeath-seq", "topics-ndeath-seq");
      return;
    }
    const flow = type === "NBIRTH" ? "message-flow-edge-node-birth-publish-nbirth" : undefined;
    this.rule(qos === 0, at, `payloads-${lower}-qos`, `topics-${lower}-mqtt`, ...(flow ? [`${flow}-qos`] : []));
    this.rule(!retain, at, `payloads-${lower}-retain`, ...(flow ? [`${flow}-retained`] : []));
    this.rule(message.timestamp > 1.6e12, at, `payloads-${lower}-timestamp`, `topics-${lower}-timestamp`);
    const within = Number.isInteger(seq) && seq >= 0 && seq <= 255;
    this.rule(within, at, `payloads-${lower}-seq`, "payloads-sequence-num-always-included");
    for (const metric of message.metrics) this.metric(metric, at);
  }

  metric(metric, at) {
    const where = `${at}, metric ${metric.name || metric.alias}`;
    this.rule(number(metric.timestamp) > 1.6e12, where, "payloads-name-birth-data-requirement", "payloads-metric-timestamp-in-UTC");
    for (const [key, property] of Object.entries(metric.properties || {})) {
      this.rule(property.type !== undefined, `${where}, ${key}`, "payloads-metric-propertyvalue-type-req");
      if (key === "Quality") {
        this.rule(property.type === "Int32", where, "payloads-propertyset-quality-value-type");
        this.rule(QUALITIES.includes(Number(property.value)), where, "payloads-propertyset-quality-value-value");
      }
    }
  }

  nodeDeath(state, message, at) {
    const [metric] = message.metrics;
    const only = message.metrics.length === 1 && metric.name === "bdSeq";
    this.rule(only, at, "payloads-ndeath-bdseq", "topics-ndeath-payload");
    const bdSeq = only ? Number(metric.value) : undefined;
    const ids = ["topics-nbirth-bdseq-matching", "payloads-nbirth-bdseq-repeat"];
    // A death without a birth before it is that of a session which waited for its host.
    if (state.born) this.rule(bdSeq === state.bdSeq, `${at}: ${bdSeq} after ${state.bdSeq}`, ...ids);
    Object.assign(state, { born: false, bdSeq });
  }

  session(state, message, lower, at) {
    const { type, device, seq } = message;
    if (type === "NBIRTH") {
      this.nodeBirth(state, message, at);
      return;
    }
    this.rule(state.born === true, `${at}: the node is not born`, `payloads-${lower}-order`);
    const ids = [`payloads-${lower}-seq-inc`, "payloads-sequence-num-incrementing"];
    this.rule(seq === (state.seq + 1) % 256, `${at}: ${seq} after ${state.seq}`, ...ids);
    state.seq = seq;
    if (type === "DBIRTH") {
      // Births of devices that come later are the only ones behind data.
      this.rule(!state.devices.has(device), `${at}: it is born already`, "operational-behavior-device-ddeath");
      state.devices.add(device);
      this.births(state, device, message, at, "dbirth");
    } else if (type === "DDEATH") {
      this.rule(message.metrics.length === 0, at, "topics-ddeath-seq-num");
      state.devices.delete(device);
    } else {
      this.data(state, device, message, at, lower);
    }
  }

  nodeBirth(state, message, at) {
    const flow = "message-flow-edge-node-birth-publish-nbirth-payload";
    this.rule(message.seq === 0, at, "topics-nbirth-seq-num", "payloads-sequence-num-zero-nbirth", `${flow}-seq`);
    const named = (name) => message.metrics.find((metric) => metric.name === name);
    const bdSeq = named("bdSeq");
    const found = bdSeq !== undefined && bdSeq.type === "Int64" && Number(bdSeq.value) >= 0 && Number(bdSeq.value) <= 255;
    this.rule(found, at, "topics-nbirth-bdseq-included", "payloads-nbirth-bdseq", `${flow}-bdSeq`);
    const value = found ? Number(bdSeq.value) : undefined;
    if (state.born) {
      this.rule(value === state.bdSeq, at, "operational-behavior-data-commands-rebirth-action-3", "payloads-nbirth-bdseq-repeat");
    } else if (state.bdSeq !== undefined) {
      this.rule(value === (state.bdSeq + 1) % 256, `${at}: ${value} after ${state.bdSeq}`, "topics-nbirth-bdseq-increment");
    }
    const rebirth = named("Node Control/Rebirth");
    const command = "operational-behavior-data-commands-rebirth";
    this.rule(rebirth !== undefined, at, `${command}-name`, "topics-nbirth-rebirth-metric", "payloads-nbirth-rebirth-req");
    this.rule(rebirth && rebirth.type === "Boolean", at, `${command}-datatype`);
    this.rule(rebirth && rebirth.value === false, at, `${command}-value`);
    this.rule(rebirth && rebirth.alias === undefined, at, `${command}-name-aliases`);
    Object.assign(state, { born: true, seq: 0, bdSeq: value, devices: new Set(), aliases: {}, names: {} });
    this.births(state, "", message, at, "nbirth");
  }

  births(state, device, message, at, lower) {
    state.names[device] = new Set();
    for (const metric of message.metrics) {
      const where = `${at}, metric ${metric.name}`;
      this.rule(Boolean(metric.name), where, "payloads-name-requirement", `topics-${lower}-metric-reqs`, "payloads-alias-birth-requirement");
      this.rule(Boolean(metric.type), where, "payloads-metric-datatype-req", "payloads-metric-datatype-value");
      this.rule(!state.names[device].has(metric.name), where, `operational-behavior-data-publish-${lower}-values`);
      state.names[device].add(metric.name);
      const alias = number(metric.alias);
      if (alias === undefined) continue;
      const own = `${device}/${metric.name}`;
      const taken = state.aliases[alias];
      const mine = taken === undefined || `${taken.device}/${taken.name}` === own;
      this.rule(mine, `${where}, alias ${alias}`, "payloads-alias-uniqueness");
      this.rule((state.ever[alias] ||= own) === own, `${where}, alias ${alias} was ${state.ever[alias]}`, "payloads-alias-uniqueness");
      state.aliases[alias] = { device, name: metric.name };
    }
  }

  data(state, device, message, at, lower) {
    const kind = device === undefined ? "" : device;
    const there = kind === "" || state.devices.has(kind);
    this.rule(there, `${at}: it is not born`, `payloads-${lower}-order`, "operational-behavior-data-publish-dbirth-values");
    for (const metric of message.metrics) {
      const alias = number(metric.alias);
      const where = `${at}, metric ${metric.name || alias}`;
      const values = `operational-behavior-data-publish-${kind === "" ? "nbirth" : "dbirth"}-values`;
      if (alias === undefined) {
        this.rule(state.names[kind] && state.names[kind].has(metric.name), where, "payloads-name-requirement", values);
      } else {
        this.rule(metric.name === undefined, where, "payloads-alias-data-cmd-requirement");
        const known = state.aliases[alias];
        this.rule(known !== undefined && known.device === kind, where, values);
      }
    }
  }
}

const [verb, argument] = process.argv.slice(2);
if (verb === "check") {
  const checker = new Checker();
  const lines = fs.readFileSync(0, "utf8").split("\n").filter((line) => line !== "");
  lines.forEach((line, index) => checker.message(line, index));
  const { checked, failed, messages } = checker;
  console.log(JSON.stringify({ checked, failed, messages }));
} else if (verb === "encode") {
  console.log(Buffer.from(sparkplug.encodePayload(JSON.parse(argument))).toString("hex"));
} else {
  console.error(`error: unknown verb ${verb}; write check or encode`);
  process.exit(2);
}
