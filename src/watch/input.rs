//! What a key means.

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

/// What a person wants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// Leave.
    Quit,
    /// Let the screen stand still, or go on.
    Pause,
    /// Select the signal so many further down.
    Select(isize),
    /// Scroll the fields of the selected signal down by so many.
    Scroll(isize),
}

/// The meaning of a key, if it has one.
pub fn action(key: KeyEvent) -> Option<Action> {
    if key.kind == KeyEventKind::Release {
        return None;
    }
    match key.code {
        // A terminal in raw mode makes no signal of it.
        KeyCode::Char('c') if key.modifiers.contains(KeyModifiers::CONTROL) => Some(Action::Quit),
        KeyCode::Char('q') | KeyCode::Esc => Some(Action::Quit),
        KeyCode::Char(' ') => Some(Action::Pause),
        KeyCode::Down | KeyCode::Tab | KeyCode::Char('j') => Some(Action::Select(1)),
        KeyCode::Up | KeyCode::BackTab | KeyCode::Char('k') => Some(Action::Select(-1)),
        KeyCode::Right | KeyCode::PageDown => Some(Action::Scroll(1)),
        KeyCode::Left | KeyCode::PageUp => Some(Action::Scroll(-1)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_mean_what_the_screen_says() {
        let press = |code| action(KeyEvent::new(code, KeyModifiers::NONE));
        assert_eq!(press(KeyCode::Char('q')), Some(Action::Quit));
        assert_eq!(press(KeyCode::Char(' ')), Some(Action::Pause));
        assert_eq!((press(KeyCode::Tab), press(KeyCode::Up)), (Some(Action::Select(1)), Some(Action::Select(-1))));
        assert_eq!((press(KeyCode::Char('c')), press(KeyCode::Char('x'))), (None, None));
        let interrupt = KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL);
        assert_eq!(action(interrupt), Some(Action::Quit));
        assert_eq!(action(KeyEvent { kind: KeyEventKind::Release, ..interrupt }), None);
    }
}
