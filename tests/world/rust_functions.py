"""Finds functions of Rust source by name. A file is read as words and signs, which is enough to know what is a function of
what; functions for tests only, and those that a macro makes, are left out.

>>> source = '''
... mod inner { impl<'a, T: Fn() -> u8> Show for Pair<'a, T> { fn show(&self) -> [u8; 2] where T: Copy { br#"}"#; '}' } } }
... pub trait Show { fn show(&self) -> [u8; 2]; fn twice(&self) { /* { /* } */ */ fn once() {} } }
... #[cfg(test)] mod tests { fn free() {} }
... pub(crate) const fn free(f: impl Fn()) {}
... '''
>>> found, _ = functions(source, ["core"])
>>> [(str(f), f.result, source[f.body[0]:f.body[1]]) for f in found]  # doctest: +NORMALIZE_WHITESPACE
[('core::inner::<Pair as Show>::show', '[u8; 2]', '{ br#"}"#; \\'}\\' }'),
 ('core::Show::twice', '', '{ /* { /* } */ */ fn once() {} }'), ('core::Show::twice::once', '', '{}'),
 ('core::free', '', '{}')]
>>> [str(f) for f in matching(found, "free") + matching(found, "Pair::show") + matching(found, "show")]
['core::free', 'core::inner::<Pair as Show>::show']
>>> functions("#[cfg(test)]\\nmod tests;", ["core"])
([], ['tests'])
"""

import dataclasses
import pathlib
import re

TOKEN = re.compile(
    r"""(?P<skip>\s+|//[^\n]*)
    |(?P<comment>/\*)
    |(?P<raw>b?c?r(?P<hashes>\#*)".*?"(?P=hashes))
    |(?P<text>[bc]?"(?:[^"\\]|\\.)*")
    |(?P<char>b?'(?:[^'\\]|\\(?:u\{[^}]*\}|x..|.))')
    |(?P<lifetime>'\w+)
    |(?P<word>(?:r\#)?\w+)
    |(?P<sign>->|=>|::|.)""",
    re.VERBOSE | re.DOTALL,
)
EDGE_OF_COMMENT = re.compile(r"/\*|\*/")
CLOSED_BY = {"{": "}", "(": ")", "[": "]"}


@dataclasses.dataclass(frozen=True)
class Function:
    path: tuple  # crate, modules, type, name
    trait: str  # of which it is, where it stands in `impl Trait for Type`
    is_method: bool
    signature: tuple  # where it begins, with `const` and `async`, and ends
    result: str  # its return type, "" without one
    body: tuple  # from the brace to behind the other
    file: str = ""

    def __str__(self):
        *around, kind, name = self.path
        return "::".join([*around, f"<{kind} as {self.trait}>" if self.trait else kind, name])


def tokens(source):
    """Text, begin and end of all but comments."""
    found, at = [], 0
    while at < len(source):
        token = TOKEN.match(source, at)
        at = token.end()
        if token.lastgroup == "comment":
            depth = 1
            while depth:
                edge = EDGE_OF_COMMENT.search(source, at)
                depth, at = depth + (1 if edge.group() == "/*" else -1), edge.end()
        elif token.lastgroup != "skip":
            found.append((token.group(), token.start(), at))
    return found


class Reader:
    """Walks through the items of a file."""

    def __init__(self, source):
        self.source = source
        self.tokens = tokens(source)
        self.words = [text for text, _, _ in self.tokens] + [""] * 3
        self.found = []
        self.of_tests = []

    def behind(self, at):
        """Behind the group that opens at `at`."""
        open, close, depth = self.words[at], CLOSED_BY[self.words[at]], 0
        while True:
            depth += (self.words[at] == open) - (self.words[at] == close)
            at += 1
            if depth == 0:
                return at

    def next(self, at, signs):
        """The next of these signs outside of parentheses and brackets."""
        while self.words[at] and self.words[at] not in signs:
            at = self.behind(at) if self.words[at] in "([" else at + 1
        return at

    def items(self, at, end, path, trait=None):
        """What is between these tokens; `trait` is None outside of a type."""
        while at < end:
            word = self.words[at]
            if word == "#" and self.words[at + 1] == "[":
                behind = self.behind(at + 1)
                is_of_tests = self.words[at + 2 : behind - 1] == ["cfg", "(", "test", ")"]
                at = self.skipped(behind) if is_of_tests else behind
            elif word == "macro_rules":
                at = self.behind(self.next(at, "{"))
            elif word in ("mod", "trait") or word == "impl" and self.opens_item(at):
                edge = self.next(at, "{;")
                behind = self.behind(edge) if self.words[edge] == "{" else edge + 1
                own, of = self.names(at + 1, edge)
                self.items(edge + 1, behind - 1, (*path, own), None if word == "mod" else of)
                at = behind
            elif word == "fn" and re.match(r"\w", self.words[at + 1]):
                at = self.function(at, path, trait)
            else:
                at += 1

    def opens_item(self, at):
        """Not so `impl` as the type of a parameter or result."""
        return at == 0 or self.words[at - 1] in ("}", ";", "{", "]", "unsafe")

    def names(self, at, edge):
        """Of what comes behind `mod`, `trait` or `impl`: its last name, and that of the trait."""
        depth, name, trait = 0, "", ""
        for word in self.words[at:edge]:
            depth += (word == "<") - (word == ">")
            if depth == 0 and word in ("where", ":"):
                break
            if depth == 0 and word == "for":
                trait = name
            elif depth == 0 and re.match(r"\w", word):
                name = word
        return name, trait

    def skipped(self, at):
        """Behind the item at `at`, which is for tests only."""
        while self.words[at] == "#":
            at = self.behind(at + 1)
        edge = self.next(at, "{;,}")
        if self.words[edge] == ";" and "mod" in self.words[at:edge]:
            self.of_tests.append(self.words[edge - 1])
        return self.behind(edge) if self.words[edge] == "{" else edge + (self.words[edge] in ";,")

    def function(self, at, path, trait):
        edge = self.next(at, "{;")
        if self.words[edge] != "{":
            return edge + 1
        behind, first = self.behind(edge), at
        while self.words[first - 1] in ("const", "async", "unsafe"):
            first -= 1
        path = (*path, self.words[at + 1])
        self.found.append(
            Function(
                path=path,
                trait=trait or "",
                is_method=trait is not None,
                signature=(self.tokens[first][1], self.tokens[edge][1]),
                result=self.result(at, edge),
                body=(self.tokens[edge][1], self.tokens[behind - 1][2]),
            )
        )
        self.items(edge + 1, behind - 1, path)
        return behind

    def result(self, at, edge):
        arrow = self.behind(next(i for i in range(at, edge) if self.words[i] == "("))
        if self.words[arrow] != "->":
            return ""
        end = next((i for i in range(arrow, edge) if self.words[i] == "where"), edge)
        return self.source[self.tokens[arrow + 1][1] : self.tokens[end][1]].strip()


def functions(source, path):
    """The functions of a file, and the names of its modules that are files for tests only."""
    reader = Reader(source)
    reader.items(0, len(reader.tokens), tuple(path))
    return reader.found, reader.of_tests


def index(tree):
    """The functions of all crates, where `tree` is the content of each file."""
    found, of_tests = [], set()
    for file, content in sorted(tree.items()):
        if not re.fullmatch(r"crates/[\w-]+/src/.*\.rs", file):
            continue
        _, crate, _, *modules = pathlib.PurePath(file).with_suffix("").parts
        if modules[-1] in ("lib", "mod"):
            modules.pop()
        here, tests = functions(content.decode(), (crate, *modules))
        of_tests |= {(crate, *modules, name) for name in tests}
        found += [dataclasses.replace(function, file=file) for function in here]
    is_of_tests = lambda f: any(f.path[:length] in of_tests for length in range(len(f.path)))
    return [function for function in found if not is_of_tests(function)]


def matching(found, name, crate=None):
    """Those that a name stands for, which may have modules in front: of one word, only functions outside of types; of
    functions of a type, its own before those of traits, as in Rust. `<Type as Trait>::name` is that of the trait."""
    trait = re.search(r"<(\w+) as (\w+)>", name)
    parts = tuple(re.sub(r"<(\w+) as (\w+)>", r"\1", name).split("::"))
    ends = [f for f in found if f.path[-len(parts) :] == parts and crate in (None, f.path[0])]
    if len(parts) == 1:
        return [f for f in ends if not f.is_method]
    if trait:
        return [f for f in ends if f.trait == trait.group(2)]
    return [f for f in ends if not f.trait] or ends
