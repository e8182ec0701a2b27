// The links to the MQTT brokers: a card each, with why the last connection ended.

import { className, clock, hide, keyed, make, text, told } from "./common.js";
import { t } from "./texts.js";

const TITLES = { mqtt: "MQTT", sparkplug: "Sparkplug" };

/// A card for each client of a broker, with a heading of that level; none without MQTT.
export function brokerCards(level) {
  const cards = new Map();
  const element = make("div", "cards brokers");
  const create = ({ name }) => {
    const card = { badge: make("span", "badge"), where: make("p", "where"), since: make("p", "where"), time: make("span"), why: told("span"), facts: make("p", "where") };
    card.error = make("p", "", card.time, " ", card.why);
    card.element = make("article", "card", make(level, "", TITLES[name] ?? name, card.badge), card.where, card.since, card.error, card.facts);
    element.append(card.element);
    return card;
  };
  return {
    element,
    show({ links, waiting, published, lost }) {
      keyed(cards, links.map((link) => ({ ...link, name: link.client })), create, (card, { client, broker, connected, since, error }) => {
        text(card.badge, connected ? `● ${t("connected")}` : `✕ ${t("not connected")}`);
        className(card.badge, `badge ${connected ? "" : "red"}`);
        text(card.where, t("Broker {broker}", { broker }));
        text(card.since, `${connected ? t("connected") : t("not connected")} ${t("since {time}", { time: clock(new Date(since)) })}`);
        hide(card.error, !error);
        // What ended an earlier connection is of interest, and no alarm.
        className(card.error, connected ? "where" : "why");
        text(card.time, error ? t("Last error, {time}:", { time: clock(new Date(error.time)) }) : "");
        text(card.why, error?.text ?? "");
        hide(card.facts, client !== "mqtt");
        text(card.facts, t("{waiting} messages waiting, {published} sent, {lost} lost", { waiting, published, lost }));
      });
    },
  };
}
